"""How grasps and views become columns, and back."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from dexzoo.data.schema import DEPTH_UNIT, SCHEMAS, decode_path, decode_view, encode_depth, encode_path, encode_view
from dexzoo.grasp import Grasps
from dexzoo.perception.camera import Camera
from dexzoo.perception.observation import Observation


@pytest.fixture
def row(can_view: Observation) -> dict[str, Any]:
    return {"scene": 3, "view": 1, **encode_view(can_view.aimed())}


def test_a_path_keeps_the_grasp(can_grasps: Grasps) -> None:
    grasps = can_grasps[:6]
    path = encode_path(grasps)
    assert path.shape == (6, 66)
    assert path.dtype == np.float32
    back = decode_path(path, grasps.grasp_type, grasps.hand)
    assert back.hand == grasps.hand
    torch.testing.assert_close(back.wrist, grasps.wrist, atol=1e-5, rtol=0)
    torch.testing.assert_close(back.joints, grasps.joints, atol=1e-5, rtol=0)
    assert torch.equal(back.grasp_type, grasps.grasp_type)


def test_a_path_holds_what_the_docstring_says(can_grasps: Grasps) -> None:
    grasps = can_grasps[:6]
    path = torch.from_numpy(encode_path(grasps)).unflatten(-1, (3, 22))
    for row, waypoint in enumerate((0, 6, 9)):
        assert torch.equal(path[:, row, :3], grasps.position[:, waypoint])
        assert torch.equal(path[:, row, 3:7], grasps.quaternion[:, waypoint])
        assert torch.equal(grasps.hand.expand(path[:, row, 7:]), grasps.joints[:, waypoint])


def test_a_view_is_kept_to_a_tenth_of_a_millimeter(can_view: Observation, row: dict[str, Any]) -> None:
    aimed = can_view.aimed()
    back = decode_view(row, row["depth"])
    assert back.camera == aimed.camera
    np.testing.assert_array_equal(back.mask, aimed.mask)
    np.testing.assert_array_equal(back.T_world_camera, aimed.T_world_camera)
    np.testing.assert_allclose(back.table, aimed.table, atol=1e-12)
    np.testing.assert_allclose(back.depth[aimed.mask], aimed.depth[aimed.mask], atol=0.51 * DEPTH_UNIT)
    assert (back.depth[~aimed.mask] == 0).all()
    np.testing.assert_allclose(back.image(), aimed.image(), atol=1e-4)


def test_a_view_is_a_16_bit_png_or_nothing(can_view: Observation, row: dict[str, Any]) -> None:
    image = cv2.imdecode(np.frombuffer(row["depth"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    assert image.shape == (224, 224)
    bare = encode_view(can_view.aimed(), 7, depth=False)
    assert (bare["seed"], bare["depth"]) == (7, None)
    assert row["seed"] is None


def test_the_columns_of_a_view_are_those_of_the_table(row: dict[str, Any]) -> None:
    assert set(row) == set(SCHEMAS["views"].names)


def test_views_that_are_not_aimed_are_refused(can_view: Observation, row: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"keeps aimed views only; give observation\.aimed\(\)"):
        encode_view(can_view)
    with pytest.raises(ValueError, match=r"scene 3, view 1 has the camera .*width=640"):
        decode_view(row | {"width": 640}, row["depth"])
    del row["fx"]
    with pytest.raises(ValueError, match="scene 3, view 1 has no fx"):
        decode_view(row, row["depth"])


@pytest.mark.parametrize("damage", [lambda png: png[:40], lambda png: b"", lambda png: _png(np.zeros((3, 4)))])
def test_a_damaged_image_is_named(row: dict[str, Any], damage: Callable[[bytes], bytes]) -> None:
    with pytest.raises(ValueError, match="the depth of scene 3, view 1 is no 16-bit PNG of 224 x 224 pixels"):
        decode_view(row, damage(row["depth"]))


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image.astype(np.uint16))[1].tobytes()


def test_depth_is_that_of_the_object_alone() -> None:
    depth = np.full((224, 224), 0.5, np.float32)
    mask = np.zeros((224, 224), bool)
    mask[100:120, 90:130] = True
    png = encode_depth(Observation(depth, Camera.aimed(), table=np.array([0, 0, -1, 0.6]), mask=mask))
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, np.where(mask, 5000, 0))
