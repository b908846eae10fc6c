"""Pictures of grasps and hands, and pages in the browser."""
