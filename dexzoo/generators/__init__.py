"""Generative models: what proposes grasps for an observation."""
