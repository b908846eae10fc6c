"""Evaluative models: they predict whether a grasp will hold."""
