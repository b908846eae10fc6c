"""How grasp sets are made: scenes, views, generated grasps, trials; on many processes or machines."""
