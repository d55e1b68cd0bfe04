"""Pictures: the camera's geometry, what is drawn over them, and their edges."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from oracles import pictures

from grasp_env.errors import InvalidInputError, SimulationError
from grasp_env.sim import Camera, CameraConfig, Scene, SceneConfig
from grasp_env.sim.picture.annotation import LONGEST, LONGEST_TURN, WRENCH_COLOR, Annotation
from grasp_env.sim.picture.camera import DIRECTION
from grasp_env.sim.picture.debug_lines import draw_debug
from grasp_env.sim.picture.legend import room
from grasp_env.sim.picture.overlay import VEIL, draw
from grasp_env.sim.picture.pixels import BACKGROUND_DEPTH, gradient, put_background, see_through, smooth_edges
from grasp_env.sim.picture.view import View

VIEW = View((0.4, 0.2, 0.5), (0.0, 0.05, 0.0), 30.0, 160, 120)
FRONT = View((0.0, 0.0, 0.5), (0.0, 0.0, 0.0), 30.0, 300, 300)  # looks along -z, x to the right
WHITE = np.full((300, 300, 3), 255, np.uint8)


@pytest.fixture(scope="module")
def scene() -> Iterator[Scene]:
    scene = Scene(SceneConfig(), visuals=True)
    yield scene
    scene.close()


def one_finger(**fields: object) -> Annotation:
    """A finger that pushes along +x with 2 N on a contact at x = -0.03."""
    given = {
        "points": [[-0.03, 0.0, 0.0]], "normals": [[1.0, 0.0, 0.0]], "forces": [[2.0, 0.0, 0.0]], "friction": [0.5],
        "active": [True], "wrench": np.zeros(6), "center": [0.1, 0.1, 0.0], "colors": [[1.0, 0.0, 0.0]], "scale": 0.025,
    }  # fmt: skip
    return Annotation(**{**given, **fields})  # pyright: ignore[reportArgumentType]


def pixel(image: np.ndarray, x: float, y: float) -> np.ndarray:
    column, row = FRONT.project([[x, y, 0.0]])[0]
    return image[round(row), round(column)].astype(int)


def test_project_is_what_opengl_does_and_unproject_goes_back() -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3))
    world = np.hstack([points, np.ones((30, 1))])
    matrices = [np.reshape(matrix, (4, 4)).T for matrix in (VIEW.view_matrix, VIEW.projection_matrix)]
    clip = world @ (matrices[1] @ matrices[0]).T
    device = clip[:, :3] / clip[:, 3:]
    pixels = VIEW.project(points)
    np.testing.assert_allclose(pixels, (device[:, :2] * [0.5, -0.5] + 0.5) * [160, 120], atol=1e-9)
    np.testing.assert_allclose(VIEW.depth(points), clip[:, 3], atol=1e-12)
    depth = np.full((120, 160), 0.5 * device[0, 2] + 0.5)
    back = VIEW.unproject(depth)
    np.testing.assert_allclose(VIEW.depth(back.reshape(-1, 3)), clip[0, 3], atol=1e-9)
    centers = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), axis=-1)
    np.testing.assert_allclose(VIEW.project(back.reshape(-1, 3)), centers.reshape(-1, 2), atol=1e-6)


@pytest.mark.parametrize("size", [(160, 120), (120, 160)])
def test_fitted_leaves_the_margins_free_and_no_more(size: tuple[int, int]) -> None:
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (200, 3))
    view = dataclasses.replace(VIEW, width=size[0], height=size[1]).fitted(points, 0.1, 0.2)
    part = view.project(points) / size
    free = np.array([part.min(axis=0), 1.0 - part.max(axis=0)])
    wanted = np.array([[0.1, 0.1], [0.1, 0.2]])
    assert (free > wanted - 1e-9).all()
    assert np.isclose(free, wanted).all(axis=0).any()  # one direction is filled
    np.testing.assert_allclose(view.axes, VIEW.axes, atol=1e-12)


def test_a_point_behind_the_camera_has_finite_pixels() -> None:
    assert np.isfinite(FRONT.project([[0.0, 0.0, 1.0], [0.3, 0.0, 0.5]])).all()


def test_project_agrees_with_the_renderer(scene: Scene) -> None:
    config = CameraConfig(width=240, height=240, object_opacity=1.0)
    camera = Camera(scene, config)
    with_object = camera.capture().astype(int)
    with scene.simulator.object_hidden():
        without = camera.capture().astype(int)
    rows, columns = np.nonzero(np.abs(with_object - without).max(axis=2) > 40)
    half = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    pixels = camera.project(half)
    # the fingers hide the left edge: right edge and lowest corner, within a pixel and the smoothing's one
    assert columns.max() == pytest.approx(pixels[:, 0].max(), abs=2.5)
    assert rows.max() == pytest.approx(pixels[:, 1].max(), abs=2.5)


@pytest.mark.parametrize("half", [0.035, 0.05, 0.06])
@pytest.mark.parametrize("size", [(96, 96), (160, 90)])
def test_all_of_hand_and_object_is_in_the_picture(scene: Scene, half: float, size: tuple[int, int]) -> None:
    default = SceneConfig()
    points = tuple((x, y, half * np.sign(z)) for x, y, z in default.contact_points)
    camera = Camera(scene, CameraConfig(width=size[0], height=size[1], object_opacity=1.0))
    cuboid = dataclasses.replace(default.object, size=(2 * half, 2 * half, 2 * half))
    scene.load(dataclasses.replace(default, object=cuboid, contact_points=points))
    camera.capture()  # finds new bodies and moves back
    _, depth = camera._shoot(camera.view, *size, shadows=False)
    drawn = depth < BACKGROUND_DEPTH
    assert drawn.mean() > 0.15
    border = np.ones_like(drawn)
    border[3:-3, 3:-3] = False  # the margin of 0.06 is more than 3 pixels
    assert not drawn[border].any()


def test_pictures_are_deterministic_and_annotations_leave_them(scene: Scene) -> None:
    camera = Camera(scene, CameraConfig(width=120, height=100))
    plain = camera.capture()
    note = one_finger(lines=[("iterations", "12")])
    noted = camera.capture(note)
    assert noted.shape == (100, 120, 3)
    assert noted.dtype == np.uint8
    assert (noted != plain).any()
    np.testing.assert_array_equal(camera.capture(note), noted)
    np.testing.assert_array_equal(camera.capture(), plain)


def test_a_closed_scene_and_a_wrong_config_say_so() -> None:
    closed = Scene(SceneConfig())
    camera = Camera(closed, CameraConfig(width=8, height=8))
    closed.close()
    with pytest.raises(SimulationError, match="closed"):
        camera.capture()
    for fields in ({"width": 0}, {"direction": (0.0, 1.0, 0.0)}, {"margin": 0.5}, {"object_opacity": 2.0},
                   {"field_of_view": 0.0}, {"footer": 0.6}):  # fmt: skip
        with pytest.raises(InvalidInputError, match=next(iter(fields))):
            CameraConfig(**fields)


def test_the_arrow_ends_at_the_contact_and_is_to_scale() -> None:
    image = draw(WHITE, one_finger(friction=[1e-6]), FRONT)
    inside = [pixel(image, -0.03 - part * 0.05, 0.0) for part in (0.2, 0.5, 0.95)]
    assert all(color[0] > 180 and color[1] < 60 for color in inside)
    for x in (-0.03 - 1.15 * 0.05, -0.03 + 0.01):  # beyond the tail, and in the object
        np.testing.assert_array_equal(pixel(image, x, 0.0), 255)


def test_the_cone_has_the_angle_of_friction() -> None:
    image = draw(WHITE, one_finger(forces=np.zeros((1, 3))), FRONT)
    for side in (1.0, -1.0):
        assert pixel(image, -0.06, side * 0.8 * 0.5 * 0.03)[1] < 235
        np.testing.assert_array_equal(pixel(image, -0.06, side * 1.3 * 0.5 * 0.03), 255)


def test_a_contact_that_is_not_active_is_a_grey_ring() -> None:
    image = draw(WHITE, one_finger(active=[False]), FRONT)
    near = image[140:160, 80:130].reshape(-1, 3).astype(int)
    assert np.ptp(near, axis=1).max() < 20  # no colour
    assert near.min() < 200
    np.testing.assert_array_equal(pixel(image, -0.03, 0.0), 255)  # hollow
    np.testing.assert_array_equal(pixel(image, -0.06, 0.0), 255)  # no arrow, no cone


def test_the_wrench_starts_at_the_center() -> None:
    note = one_finger(active=[False], wrench=[0.0, -1.0, 0.0, 0.0, 0.0, 0.2], center=[0.0, 0.05, 0.0])
    image = draw(WHITE, note, FRONT)
    np.testing.assert_array_equal(pixel(image, 0.0, 0.03), WRENCH_COLOR)
    moment = draw(WHITE, dataclasses.replace(note, wrench=[0.0, 0.0, 0.0, 0.0, 0.0, 0.2]), FRONT)
    # seen from +z a moment about +z turns to the left above the centre and starts at the right
    ring = np.array(
        [pixel(moment, 0.03 * np.cos(a), 0.05 + 0.03 * np.sin(a))[1] for a in np.radians([20, 90, 160, 320])]
    )
    assert (ring < 200).tolist() == [True, True, True, False]


def test_a_measured_force_is_a_dark_line() -> None:
    image = draw(WHITE, one_finger(measured=[[2.0, -1.0, 0.0]], friction=[1e-6]), FRONT)
    assert pixel(image, -0.03 - 0.04, 0.02).max() < 140


def test_the_scale_keeps_the_longest_arrow_below_its_limit() -> None:
    for force in (0.7, 3.0, 50.0):
        scale = one_finger(forces=[[force, 0.0, 0.0]], scale=None).force_scale
        assert force * scale == pytest.approx(LONGEST)
    for force in (0.0, 0.01):  # near nothing is not blown up
        assert one_finger(forces=[[force, 0.0, 0.0]], scale=None).force_scale == pytest.approx(LONGEST / 0.1)
    weak, strong = (one_finger(wrench=[0.0, 0.0, 0.0, 0.0, 0.0, moment]).moment_scale for moment in (1e-5, 0.5))
    assert weak == pytest.approx(LONGEST_TURN / 0.02)
    assert 0.5 * strong == pytest.approx(LONGEST_TURN)
    assert one_finger().force_scale == 0.025


def test_what_is_not_drawn_on_is_only_veiled() -> None:
    image = np.random.default_rng(0).integers(0, 256, (300, 300, 3)).astype(np.uint8)
    kept = image.copy()
    out = draw(image, one_finger(), FRONT)
    np.testing.assert_array_equal(image, kept)
    veiled = np.round(255 - (1.0 - VEIL) * (255.0 - image))
    np.testing.assert_array_equal(out[:100], veiled[:100])


@pytest.mark.parametrize("size", [(480, 480), (240, 240), (64, 48), (1, 1)])
def test_every_size_and_every_place_can_be_drawn(size: tuple[int, int]) -> None:
    view = dataclasses.replace(FRONT, width=size[0], height=size[1])
    image = np.zeros((size[1], size[0], 3), np.uint8)
    for place in ([0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.5]):
        note = one_finger(
            points=[place], center=place, wrench=np.ones(6), colors=None, lines=[("margin", "0.31 N")] * 4
        )
        assert draw(image, note, view).shape == image.shape


def test_an_annotation_says_what_is_wrong() -> None:
    for fields, name in (({"forces": np.zeros((2, 3))}, "forces"), ({"friction": [np.nan]}, "friction"),
                         ({"wrench": np.zeros(3)}, "wrench"), ({"measured": np.zeros(3)}, "measured"),
                         ({"scale": 0.0}, "scale")):  # fmt: skip
        with pytest.raises(InvalidInputError, match=name):
            one_finger(**fields)


def test_backgrounds_and_seeing_through_agree_with_numpy() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (9, 7, 4)).astype(np.uint8)
    depth, other = (np.where(rng.random((9, 7)) < 0.5, 1.0, 0.9).astype(np.float32) for _ in range(2))
    background = gradient(7, 9, (255, 250, 240), (10, 20, 30))
    assert background[0, 3].tolist() == [255, 250, 240, 255]
    assert background[-1, 3].tolist() == [10, 20, 30, 255]
    out = put_background(pixels, depth, background)
    np.testing.assert_array_equal(out, np.where(depth[:, :, None] == 1.0, background, pixels))
    mixed = see_through(out, depth, background, other, 0.6)
    blend = np.floor(0.6 * out + 0.4 * background + 0.5)
    np.testing.assert_array_equal(mixed, np.where((depth != other)[:, :, None], blend, out))


def test_smooth_edges_pixel_by_pixel() -> None:
    rng = np.random.default_rng(0)
    steps = np.repeat(np.repeat(rng.integers(0, 256, (8, 6, 4)), 5, axis=0), 4, axis=1)
    for picture in (steps, steps // 8, rng.integers(0, 256, (30, 21, 4)), np.full((2, 1, 4), 7)):
        image = picture.astype(np.uint8)
        np.testing.assert_array_equal(smooth_edges(image), pictures.smooth_edges(image[..., :3]))


@pytest.mark.parametrize("angle", [0.1, 0.35, 0.7, 1.2])
def test_smooth_edges_come_nearer_to_the_true_coverage(angle: float) -> None:
    def half_plane(factor: int) -> np.ndarray:
        x = (np.arange(64 * factor) + 0.5) / factor - 32.0
        inside = np.cos(angle) * x[None, :] + np.sin(angle) * x[:, None] > 0.3
        return 255.0 * inside.reshape(64, factor, 64, factor).mean(axis=(1, 3))

    jagged = np.repeat(half_plane(1)[:, :, None], 4, axis=2).astype(np.uint8)
    smooth, jagged = smooth_edges(jagged), jagged[..., :3]
    truth = half_plane(16)[:, :, None]
    error = [np.sqrt(np.mean((image[4:-4, 4:-4] - truth[4:-4, 4:-4]) ** 2)) for image in (jagged, smooth)]
    assert error[1] < 0.85 * error[0]
    far = np.abs(truth[:, :, 0] - 127.5) == 127.5
    far &= (jagged[:, :, 0] == np.roll(jagged[:, :, 0], 3, 0)) & (jagged[:, :, 0] == np.roll(jagged[:, :, 0], -3, 0))
    far &= (jagged[:, :, 0] == np.roll(jagged[:, :, 0], 3, 1)) & (jagged[:, :, 0] == np.roll(jagged[:, :, 0], -3, 1))
    np.testing.assert_array_equal(smooth[far], jagged[far])


def test_debug_lines_without_a_window_do_nothing(scene: Scene) -> None:
    lines = draw_debug(scene.simulator.client.number, one_finger())
    assert len(draw_debug(scene.simulator.client.number, one_finger(), lines)) == 2


def test_contacts_are_looked_at_from_where_they_are_seen(scene: Scene) -> None:
    camera = Camera(scene, CameraConfig(width=96, height=96))
    away = View((0.0, 1.2, 1e-3), (0.0, 0.0, 0.0), 40.0, 160, 160)  # from above, through the palm
    with scene.simulator.object_hidden():
        assert camera._contacts_seen(dataclasses.replace(away, eye=(0.86, 0.13, 0.86))) == 4
        assert camera._contacts_seen(away) < 4
    np.testing.assert_allclose(camera.view.axes[2], np.array(DIRECTION) / np.linalg.norm(DIRECTION), atol=1e-6)
    asked = Camera(scene, CameraConfig(width=96, height=96, direction=(0.0, 0.5, 1.0)))
    np.testing.assert_allclose(asked.view.axes[2], np.array([0.0, 0.5, 1.0]) / np.hypot(0.5, 1.0), atol=1e-6)


@pytest.mark.parametrize("size", [(480, 480), (320, 320), (320, 240), (1280, 720), (200, 400)])
def test_words_have_their_place_beside_hand_and_arrows(scene: Scene, size: tuple[int, int]) -> None:
    margin, footer = room(*size)
    camera = Camera(scene, CameraConfig(*size, margin=margin, footer=footer, arrows=LONGEST, object_opacity=1.0))
    view, image = camera.view, np.full((size[1], size[0], 3), 120, np.uint8)
    none = np.zeros((0, 3))
    note = Annotation(none, none, none, none[:, 0], none[:, 0], np.zeros(6), np.zeros(3), none,
                      [("drift", "0.00 mm")] * 5, title="hold: random wrench", hand="four finger")  # fmt: skip
    plain = round(255 - (1.0 - VEIL) * (255 - 120))
    words = (draw(image, note, view) != plain).any(axis=2)
    assert words[: size[1] // 8].any()
    assert words[-size[1] // 8 :].any()
    _, depth = camera._shoot(view, *size, shadows=False)
    assert not (words & (depth < BACKGROUND_DEPTH)).any()
    ends = view.project(np.vstack([0.95 * LONGEST * np.eye(3), -0.95 * LONGEST * np.eye(3)])).astype(int)
    assert not words[ends[:, 1], ends[:, 0]].any()
