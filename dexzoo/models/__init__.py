"""Evaluative models: what predicts whether a grasp will hold."""
