"""Which evaluator to use, and why: models, the generator's likelihood and a coin on the same grasps."""
