"""The page is served as users see it, and driven in a headless browser as they would."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dexzoo import rotation
from dexzoo.hand import Hand
from dexzoo.viewing.hand_page import HandPage, view, view_hand

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

CHROMIUM = shutil.which("chromium")
FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # no network beyond this machine
    "--disable-quic",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
]
# name, limits and all text of each slider's row
SLIDERS = """() => [...document.querySelectorAll('[role=slider]')].map(slider => {
    let row = slider;
    while (!row.querySelector('label')) row = row.parentElement;
    const [lower, upper] = [slider.ariaValueMin, slider.ariaValueMax].map(Number);
    return [row.querySelector('label').innerText, lower, upper, row.innerText];
})"""
PATIENCE = 20_000  # ms; the first picture takes seconds where the processor draws it

# one browser and one page for all tests
pytestmark = pytest.mark.xdist_group("viewer")


@pytest.fixture(scope="module")
def page(hand: Hand) -> Iterator[HandPage]:
    pytest.importorskip("viser", reason="viser is not installed (extra `viewer`)")
    page = view_hand(hand, port=0)
    yield page
    page.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    pytest.importorskip("viser", reason="viser is not installed (extra `viewer`)")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra `dev`)")
    if CHROMIUM is None:
        pytest.skip("there is no chromium on the path")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def opened(page: HandPage, browser: Browser) -> tuple[Page, list[str]]:
    """The page with all its controls, and the addresses that it asked for."""
    tab = browser.new_page(viewport={"width": 760, "height": 600})
    tab.set_default_timeout(PATIENCE)
    asked: list[str] = []
    tab.on("request", lambda request: asked.append(request.url))
    tab.on("websocket", lambda socket: asked.append(socket.url.replace("ws:", "http:")))
    tab.goto(page.url)
    tab.get_by_text("little_pip", exact=True).wait_for()
    return tab, asked


@pytest.fixture
def tab(page: HandPage, opened: tuple[Page, list[str]]) -> Page:
    page.reset()
    wait_for(opened[0], lambda: opened[0].locator("[role=slider][aria-valuenow='0']").count() == 15)
    return opened[0]


def wait_for(tab: Page, condition: Callable[[], bool]) -> None:
    for _ in range(PATIENCE // 50):
        if condition():
            return
        tab.wait_for_timeout(50)
    pytest.fail("nothing happened")


def row(tab: Page, joint: str) -> Locator:
    """The slider and the number box beside the name of a joint."""
    return tab.locator("label", has_text=joint).locator("xpath=ancestor::*[.//*[@role='slider']][1]")


def link_poses(page: HandPage) -> torch.Tensor:
    """Poses of the scene's links, (link, 4, 4)."""
    pose = torch.eye(4, dtype=torch.float64).repeat(len(page.links), 1, 1)
    pose[:, :3, :3] = rotation.to_matrix(torch.tensor(np.stack([link.wxyz for link in page.links.values()])))
    pose[:, :3, 3] = torch.tensor(np.stack([link.position for link in page.links.values()]))
    return pose


def shows(page: HandPage, posture: torch.Tensor) -> bool:
    return torch.allclose(link_poses(page), page.hand.forward_kinematics(posture), atol=1e-6)


def picture(tab: Page) -> NDArray[np.uint8]:
    """The scene, without what lies over it."""
    png = tab.screenshot(clip={"x": 0, "y": 160, "width": 360, "height": 440})
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(image, np.uint8)


def still_picture(tab: Page) -> NDArray[np.uint8]:
    """The scene once it has come to rest with something in it."""
    last = picture(tab)
    for _ in range(40):
        tab.wait_for_timeout(100)
        last, before = picture(tab), last
        if np.ptp(last) > 0 and np.array_equal(last, before):
            return last
    pytest.fail("the scene never came to rest")


def test_every_free_joint_has_a_slider_between_its_limits(tab: Page, hand: Hand) -> None:
    seen = tab.evaluate(SLIDERS)
    assert [name for name, *_ in seen] == hand.freedoms
    for name, lower, upper, text in seen:
        joint = hand.spec.joint(name)
        assert [lower, upper] == pytest.approx(np.rad2deg([joint.lower, joint.upper]), abs=0.05)
        assert {f"{lower:g}°", f"{upper:g}°"} <= set(text.split())
    assert set(hand.spec.pads) <= set(tab.locator("body").inner_text().split())


def test_dragging_a_slider_moves_that_finger_alone(tab: Page, page: HandPage) -> None:
    before, drawn = link_poses(page), still_picture(tab)
    slider = row(tab, "index_mcp").get_by_role("slider")
    slider.scroll_into_view_if_needed()
    handle = slider.bounding_box()
    assert handle is not None
    x, y = handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(x + 60, y, steps=5)
    tab.mouse.up()
    asked = torch.zeros(20, dtype=torch.float64)
    shown = math.radians(float(str(slider.get_attribute("aria-valuenow"))))
    asked[page.hand.joint_names.index("index_mcp")] = shown
    assert shown > 0.1
    wait_for(tab, lambda: shows(page, asked))  # the drag's steps arrive one after the other
    moved = (link_poses(page) - before).abs().amax((1, 2)) > 1e-9
    names = {name for name, is_moved in zip(page.links, moved, strict=True) if is_moved}
    assert names == {"index_proximal", "index_middle", "index_distal", "index_tip"}
    wait_for(tab, lambda: bool((picture(tab) != drawn).any(-1).mean() > 0.005))

    def the_lower_palm_stays() -> bool:
        """And the floor before it; both pictures are taken anew, since a busy browser is late with the first."""
        page.move(page.hand.reduce(asked))
        bent = still_picture(tab)
        page.reset()
        opened = still_picture(tab)
        return bool((bent != opened).any(-1).mean() > 0.005) and np.array_equal(bent[250:], opened[250:])

    wait_for(tab, the_lower_palm_stays)


def test_a_typed_number_moves_the_coupled_joint_too(tab: Page, page: HandPage) -> None:
    row(tab, "thumb_pip").get_by_role("textbox").fill("40")
    tab.keyboard.press("Tab")
    asked = torch.zeros(20, dtype=torch.float64)
    for name in ("thumb_pip", "thumb_dip"):
        asked[page.hand.joint_names.index(name)] = torch.deg2rad(torch.tensor(40.0))
    wait_for(tab, lambda: shows(page, asked))


def test_random_postures_lie_within_the_limits_and_reset_opens_the_hand(tab: Page, page: HandPage) -> None:
    tab.get_by_text("Random", exact=True).click()
    wait_for(tab, lambda: int((page.posture != 0).sum()) == 20 and shows(page, page.posture))
    page.hand.check(page.posture, tolerance=1e-6)
    tab.get_by_text("Reset", exact=True).click()
    wait_for(tab, lambda: not page.posture.any() and shows(page, page.posture))


def test_frames_come_and_go(tab: Page, page: HandPage) -> None:
    box = tab.get_by_label("Link frames")
    box.click()
    wait_for(tab, lambda: all(link.show_axes for link in page.links.values()))
    box.click()
    wait_for(tab, lambda: not any(link.show_axes for link in page.links.values()))


def test_the_page_needs_no_network(opened: tuple[Page, list[str]], page: HandPage) -> None:
    asked = opened[1]
    assert any(address.startswith(page.url) for address in asked)
    assert [address for address in asked if not address.startswith((page.url, "data:", "blob:"))] == []


def test_a_hand_of_another_build(hand: Hand, browser: Browser) -> None:
    """Without pads, fingers are named by their first link; a coupling that is not one to one is written out."""
    joints = tuple(
        replace(joint, multiplier=0.5, offset=0.1) if joint.name == "ring_dip" else joint for joint in hand.spec.joints
    )
    other = view_hand(Hand(replace(hand.spec, joints=joints, pads={})), port=0)
    tab = browser.new_page()
    try:
        tab.goto(other.url)
        tab.get_by_text("ring_dip = 0.5 ring_pip + 5.7°").wait_for(timeout=PATIENCE)
        assert tab.get_by_text("thumb_base").filter(visible=True).count() >= 1
    finally:
        tab.close()
        other.stop()


def test_the_ends_of_the_sliders_are_postures_that_can_be(page: HandPage) -> None:
    for limit in (page.hand.lower, page.hand.upper):
        page.move(page.hand.reduce(limit))
        page.hand.check(page.posture, tolerance=1e-6)
        assert torch.allclose(page.posture, limit.double(), atol=1e-3)


def test_view_ends_when_interrupted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    viser = pytest.importorskip("viser", reason="viser is not installed (extra `viewer`)")

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(viser.ViserServer, "sleep_forever", interrupt)
    view("dlr2", "left", port=0)
    out, err = capsys.readouterr()
    assert out == ""
    assert "http://127.0.0.1:" in err


def test_without_viser_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch, hand: Hand) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ValueError, match=r"needs viser; install it with `pip install dexzoo\[viewer\]`"):
        view_hand(hand, port=0)


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_that_cannot_be_is_refused(hand: Hand, port: int) -> None:
    with pytest.raises(ValueError, match=f"port is {port}, expected 0 to 65535"):
        view_hand(hand, port)
