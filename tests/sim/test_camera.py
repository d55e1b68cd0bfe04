"""Pictures: the camera's geometry, annotations and their text, and smooth edges."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from engines import bullet, needs_bullet
from hands import numbers
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from grasp_env.errors import InvalidInputError
from grasp_env.sim import HANDS, Scene
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.picture.annotation import LONGEST, LONGEST_TURN, WRENCH_COLOR, Annotation
from grasp_env.sim.picture.camera import DIRECTION, Camera, CameraConfig
from grasp_env.sim.picture.edges import smooth_edges
from grasp_env.sim.picture.overlay import VEIL, draw, room
from grasp_env.sim.picture.painter import BACKGROUND_DEPTH, lines_of
from grasp_env.sim.picture.portrait import portrait
from grasp_env.sim.picture.view import FAR_PLANE, NEAR_PLANE, View

VIEW = View((0.4, 0.2, 0.5), (0.0, 0.05, 0.0), 30.0, 160, 120)
FRONT = View((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), 30.0, 300, 300)  # looks along -z, x to the right


@pytest.fixture(scope="module")
def scene():
    scene = Scene(SceneConfig(), visuals=True)
    yield scene
    scene.close()


def one_finger(**fields: Any) -> Annotation:
    """A red finger that pushes along +x with 2 N on a contact at x = -0.03; no wrench."""
    given = {
        "points": [[-0.03, 0.0, 0.0]],
        "normals": [[1.0, 0.0, 0.0]],
        "forces": [[2.0, 0.0, 0.0]],
        "friction": [1e-6],
        "measured": [[2.0, 0.0, 0.0]],
        "active": [True],
        "colors": [[1.0, 0.0, 0.0]],
        "wrench": np.zeros(6),
        "center": [0.1, 0.1, 0.0],
        "scale": 0.025,
        "turn": LONGEST_TURN / 0.2,
    }
    return Annotation(**{**given, **fields})


@needs_bullet
def test_project_is_that_of_opengl():
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3))
    matrices = (
        bullet.computeProjectionMatrixFOV(VIEW.field_of_view, 160 / 120, NEAR_PLANE, FAR_PLANE),
        bullet.computeViewMatrix(VIEW.eye, VIEW.target, (0.0, 1.0, 0.0)),
    )
    project, look = (np.reshape(matrix, (4, 4)).T for matrix in matrices)  # in single precision
    clip = np.hstack([points, np.ones((30, 1))]) @ (project @ look).T
    device = clip[:, :3] / clip[:, 3:]
    assert_allclose(
        VIEW.project(points), (device[:, :2] * [0.5, -0.5] + 0.5) * [160, 120], atol=1e-3
    )
    assert_allclose(VIEW.depth(points), clip[:, 3], atol=1e-6)
    back = VIEW.unproject(np.full((120, 160), 0.5 * device[0, 2] + 0.5)).reshape(-1, 3)
    assert_allclose(VIEW.depth(back), clip[0, 3], atol=1e-5)
    centers = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), axis=-1)
    assert_allclose(VIEW.project(back), centers.reshape(-1, 2), atol=1e-6)
    assert np.isfinite(VIEW.project([3.0 * np.array(VIEW.eye)])).all()  # behind the camera


@pytest.mark.parametrize("size", [(160, 120), (120, 160)])
def test_fitted_leaves_the_margins_free(size):
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (200, 3))
    view = dataclasses.replace(VIEW, width=size[0], height=size[1]).fitted(points, 0.1, 0.2)
    part = view.project(points) / size
    free = np.array([part.min(axis=0), 1.0 - part.max(axis=0)])
    wanted = np.array([[0.1, 0.1], [0.1, 0.2]])
    assert (free > wanted - 1e-9).all()
    assert np.isclose(free, wanted).all(axis=0).any()  # one direction is filled
    assert_allclose(view.axes, VIEW.axes, atol=1e-12)


def test_pictures_show_what_is_behind_the_object(scene):
    camera = Camera(scene, CameraConfig(width=240, height=240, object_opacity=1.0))
    opaque = camera.capture().astype(int)
    with camera.painter.object_hidden():
        without = camera.capture().astype(int)
    rows, columns = np.nonzero(np.abs(opaque - without).max(axis=2) > 40)
    pixels = camera.view.project(
        0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    )
    # the fingers hide the left edge: right edge and lowest corner, within a pixel and the
    # smoothing's one
    assert columns.max() == pytest.approx(pixels[:, 0].max(), abs=2.5)
    assert rows.max() == pytest.approx(pixels[:, 1].max(), abs=2.5)
    # nothing before or behind but the palm's shadow
    row, column = camera.view.project([[0.02, -0.04, 0.05]])[0, ::-1].astype(int)
    half_open = (
        Camera(scene, CameraConfig(width=240, height=240, object_opacity=0.5)).capture().astype(int)
    )
    assert np.abs(half_open[row, column] - 0.5 * (opaque + without)[row, column]).max() <= 2.0
    assert np.abs(opaque - without)[row, column].max() > 10
    for at, shade in ((0, (253, 253, 254)), (-1, (226, 231, 238))):
        assert np.abs(opaque[at, at] - shade).max() <= 1


def test_hand_and_object_fill_the_picture(scene):
    default = SceneConfig()
    half = 0.06
    points = tuple((x, y, half * np.sign(z)) for x, y, z in default.contact_points)
    camera = Camera(scene, CameraConfig(width=160, height=90, object_opacity=1.0))
    cuboid = dataclasses.replace(default.object, size=(2 * half, 2 * half, 2 * half))
    scene.load(dataclasses.replace(default, object=cuboid, contact_points=points))
    camera.capture()  # finds new bodies and moves back
    _, depth = camera.painter.shoot(camera.view)
    drawn = depth < BACKGROUND_DEPTH
    assert drawn.mean() > 0.15
    drawn[3:-3, 3:-3] = False  # the margin of 0.06 is more than 3 pixels
    assert not drawn.any()
    scene.load(default)


def test_hidden_contacts_are_counted(scene):
    camera = Camera(scene, CameraConfig(width=96, height=96))
    above = View((0.0, 1.2, 1e-3), (0.0, 0.0, 0.0), 40.0, 160, 160)  # through the palm
    with camera.painter.object_hidden():
        assert camera._contacts_seen(dataclasses.replace(above, eye=(0.86, 0.13, 0.86))) == 4
        assert camera._contacts_seen(above) < 4
    given = Camera(scene, CameraConfig(width=96, height=96, direction=(0.0, 0.5, 1.0))).view.axes[2]
    assert_allclose(given, np.array([0.0, 0.5, 1.0]) / np.sqrt(1.25), atol=1e-6)
    assert camera.view.axes[2] @ DIRECTION / np.linalg.norm(DIRECTION) == pytest.approx(1.0)


def test_pictures_leave_the_scene_alone(scene):
    state = numbers(scene)
    camera = Camera(scene, CameraConfig(width=120, height=100))
    note = one_finger(lines=[("iterations", "12")])
    plain = camera.capture()
    noted = camera.capture(note)
    assert (noted.shape, noted.dtype) == ((100, 120, 3), np.uint8)
    assert (noted != plain).any()
    assert_array_equal(camera.capture(note), noted)
    assert_array_equal(camera.capture(), plain)
    fine = Camera(scene, CameraConfig(width=120, height=100, supersampling=2)).capture()
    assert 0.0 < np.abs(fine.astype(int) - plain).mean() < 10.0
    assert_array_equal(numbers(scene), state)


@pytest.mark.parametrize(
    ("make", "fields"),
    [
        (CameraConfig, fields)
        for fields in (
            {"width": 0},
            {"direction": (0.0, 1.0, 0.0)},
            {"margin": 0.5},
            {"object_opacity": 2.0},
            {"field_of_view": 0.0},
            {"footer": 0.6},
        )
    ]
    + [
        (one_finger, fields)
        for fields in (
            {"forces": np.zeros((2, 3))},
            {"friction": [np.nan]},
            {"wrench": np.zeros(3)},
            {"scale": 0.0},
            {"turn": -1.0},
        )
    ],
)
def test_invalid_arguments(make, fields):
    with pytest.raises(InvalidInputError, match=next(iter(fields))):
        make(**fields)


LOOKS = {
    "blank": lambda color: (color == 255).all(),
    "red": lambda color: color[0] > 180 and color[1] < 60,
    "tint": lambda color: color[1] < 235,
    "dark": lambda color: color.max() < 140,
    "grey": lambda color: np.ptp(color) < 20 and color.max() < 225,
    "wrench": lambda color: (color == WRENCH_COLOR).all(),
    "ring": lambda color: color[1] < 200,
}
DRAWN = {
    "an arrow ends at its contact and is to scale": (
        {"measured": np.zeros((1, 3))},
        {
            "red": [(-0.04, 0.0), (-0.055, 0.0), (-0.0775, 0.0)],
            "blank": [(-0.0875, 0.0), (-0.02, 0.0)],
        },
    ),
    "a measured force is a dark line": (
        {"measured": [[2.0, -1.0, 0.0]]},
        {"dark": [(-0.07, 0.02)], "red": [(-0.055, 0.0)], "blank": [(-0.01, -0.01)]},
    ),
    "a cone has the angle of friction": (
        {"forces": np.zeros((1, 3)), "measured": np.zeros((1, 3)), "friction": [0.5]},
        {"tint": [(-0.06, 0.012), (-0.06, -0.012)], "blank": [(-0.06, 0.0195), (-0.06, -0.0195)]},
    ),
    "an inactive contact is a grey ring": (
        {"active": [False], "friction": [0.5]},
        {"blank": [(-0.03, 0.0), (-0.06, 0.0), (-0.06, 0.012)], "grey": [(-0.03, 0.0034)]},
    ),
    "a wrench starts at the center, twice as long": (
        {"active": [False], "wrench": [0.0, -1.0, 0.0, 0.0, 0.0, 0.0], "center": [0.0, 0.05, 0.0]},
        {"wrench": [(0.0, 0.03), (0.0, 0.007)], "blank": [(0.0, -0.005)]},
    ),
    # seen from +z a moment about +z turns to the left above the centre and starts at the right
    "a moment turns about its axis": (
        {"active": [False], "wrench": [0.0, 0.0, 0.0, 0.0, 0.0, 0.12], "center": [0.0, 0.05, 0.0]},
        {
            "ring": [
                (0.03 * np.cos(a), 0.05 + 0.03 * np.sin(a)) for a in np.radians([20, 90, 140])
            ],
            "blank": [(0.03 * np.cos(a), 0.05 + 0.03 * np.sin(a)) for a in np.radians([225, 320])],
        },
    ),
}


@pytest.mark.parametrize("what", DRAWN)
def test_drawn(what):
    fields, expected = DRAWN[what]
    image = np.array(
        draw(Image.new("RGB", (300, 300), "white"), one_finger(**fields), FRONT)
    ).astype(int)
    for look, places in expected.items():
        for x, y in places:
            column, row = FRONT.project([[x, y, 0.0]])[0].round().astype(int)
            assert LOOKS[look](image[row, column]), (look, x, y, image[row, column])


@pytest.mark.parametrize("size", [(64, 48), (1, 1)])
def test_every_size_and_every_place_can_be_drawn(size):
    """Pixels that are not drawn on are only veiled."""
    view = dataclasses.replace(FRONT, width=size[0], height=size[1])
    for place in ([0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.5]):
        note = one_finger(
            points=[place], center=place, wrench=np.ones(6), lines=[("margin", "0.31 N")] * 4
        )
        assert draw(Image.new("RGB", size), note, view).size == size
    image = np.random.default_rng(0).integers(0, 256, (300, 300, 3)).astype(np.uint8)
    out = np.array(draw(Image.fromarray(image), one_finger(), FRONT))
    assert_array_equal(out[:100], np.round(255 - (1.0 - VEIL) * (255.0 - image))[:100])


@pytest.mark.parametrize("size", [(480, 480), (320, 240)])
def test_text_has_its_place_beside_hand_and_arrows(scene, size):
    margin, footer = room(*size)
    camera = Camera(
        scene, CameraConfig(*size, margin=margin, footer=footer, arrows=LONGEST, object_opacity=1.0)
    )
    lines = [("lost after", "1.20 s"), ("drift", "0.31 mm"), ("tilt", "0.02 deg")]
    none = {
        name: np.zeros((0, 3)) for name in ("points", "normals", "forces", "measured", "colors")
    }
    note = one_finger(
        **none,
        friction=[],
        active=[],
        center=np.zeros(3),
        title="hold: random wrench",
        hand="four finger",
        lines=lines,
    )
    plain = np.array(draw(Image.new("RGB", size, (120, 120, 120)), note, camera.view)).astype(int)
    text = (plain != round(255 - (1.0 - VEIL) * (255 - 120))).any(axis=2)
    _, depth = camera.painter.shoot(camera.view)
    assert text.mean() > 0.1
    assert not (text & (depth < BACKGROUND_DEPTH)).any()
    ends = camera.view.project(
        np.vstack([0.95 * LONGEST * np.eye(3), -0.95 * LONGEST * np.eye(3)])
    ).astype(int)
    assert not text[ends[:, 1], ends[:, 0]].any()
    alarmed = dataclasses.replace(note, alarm="lost: no force closure")
    after = np.array(draw(Image.new("RGB", size, (120, 120, 120)), alarmed, camera.view)).astype(
        int
    )
    red = (after[..., 0] - after[..., 1:].max(axis=2) > 80) & (
        plain[..., 0] - plain[..., 1:].max(axis=2) < 80
    )
    assert red[: size[1] // 2].sum() > 20  # the alarm
    assert red[size[1] // 2 :, : size[0] // 3].sum() > 20  # the first of the lines


@pytest.mark.parametrize(("angle", "most"), [(0.02, 0.85), (0.7, 0.6), (1.5, 0.4)])
def test_smooth_edges_are_nearer_to_the_truth(angle, most):
    def half_plane(factor: int) -> np.ndarray:
        x = (np.arange(64 * factor) + 0.5) / factor - 32.0
        inside = np.cos(angle) * x[None, :] + np.sin(angle) * x[:, None] > 0.3
        return 255.0 * inside.reshape(64, factor, 64, factor).mean(axis=(1, 3))

    jagged = np.repeat(half_plane(1)[:, :, None], 3, axis=2).astype(np.uint8)
    jagged[..., 2] //= 2  # a colour
    smooth = np.array(smooth_edges(Image.fromarray(jagged)))
    truth = half_plane(16)[:, :, None] * [1.0, 1.0, 0.5]
    error = [
        np.sqrt(np.mean((image[4:-4, 4:-4] - truth[4:-4, 4:-4]) ** 2)) for image in (jagged, smooth)
    ]
    assert error[1] < most * error[0]


def test_lines_end_at_contacts():
    (start, end, _), (_, tip, _) = lines_of(one_finger(wrench=[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
    assert_allclose(
        [start, end, tip], [[-0.08, 0.0, 0.0], [-0.03, 0.0, 0.0], [0.1, 0.15, 0.0]], atol=1e-12
    )
    assert_allclose(*lines_of(one_finger(active=[False]))[0][:2])


def test_portraits_are_upright():
    hand = HANDS["four_finger"]()  # its palm is above the object
    picture = portrait(hand, 96).astype(int)
    assert picture.shape == (96, 192, 3)
    solid = picture[:, 96:]
    red = (solid[..., 0] > 150) & (solid[..., 1] < 90)
    palm = solid.max(axis=2) < 140
    assert red.sum() > 20
    assert np.nonzero(red)[0].mean() < np.nonzero(palm)[0].mean() - 20
    bent = portrait(hand, 96, np.array(hand.home) + 0.3)
    assert (np.abs(bent - picture) > 60).mean() > 0.01
