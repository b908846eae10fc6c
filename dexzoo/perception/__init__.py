"""From a depth image to a prepared view: camera, table, object, surroundings.

camera.py        pinhole cameras
files.py         depth images and camera files on disk
observation.py   one depth image with its camera and the table; the object in it
table.py         the table's plane
segmentation.py  the object's pixels
surface.py       normals and curvatures
hidden_side.py   a guess of the object's hidden side
surroundings.py  other things on the table, and the object's support
memo.py          results that are computed once
view.py          all of it for one observation, each computed once
"""

from dexzoo.perception.camera import Camera
from dexzoo.perception.observation import Observation
from dexzoo.perception.view import View

__all__ = ["Camera", "Observation", "View"]
