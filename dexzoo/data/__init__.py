"""Grasp sets: how they lie on disk, how they are made, how they become batches."""
