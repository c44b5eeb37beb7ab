"""The preview shows what is lit, from where it can be seen; pyvista is opened only where it can draw."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace

import numpy as np
import pytest
from PIL import Image

from radiosity import view
from radiosity.patches import PatchMesh, build_mesh
from workbench.errors import InputError, MissingLibraryError, OptionError
from workbench.geometry.flat import Geometry
from workbench.scene.model import Camera, Material, Scene, Surface

CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
OUTWARD = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]


@dataclass
class Solved:
    """As much of a solution as a picture needs."""

    scene: Scene
    mesh: PatchMesh
    radiosity: np.ndarray


def material(name, reflectance=0.5, emission=0.0, bands=3):
    zero = np.zeros(bands)
    return Material(name, np.full(bands, reflectance), np.full(bands, emission), zero, np.inf, zero)


def box(name, low, high, *, inward, material):
    corners = np.asarray(low) + CORNERS * (np.asarray(high) - np.asarray(low))
    faces = [face[::-1] if inward else face for face in OUTWARD]
    return Surface.from_polygons(name, material, [corners[face] for face in faces])


def solved(*surfaces, camera=None, elements=None, background=0.0):
    bands = len(surfaces[0].material.reflectance)
    scene = Scene("test", tuple(surfaces), camera=camera, bands=bands, background=np.full(bands, background))
    mesh = build_mesh(scene, Geometry.from_scene(scene), elements=elements)
    return Solved(scene, mesh, mesh.emission + 1.0 * mesh.reflectance)


def camera(eye, look_at, fov_deg=60.0, size=32, up=(0, 0, 1)):
    return Camera(np.asarray(eye, float), np.asarray(look_at, float), np.asarray(up, float), fov_deg, size, size)


def test_inside_an_evenly_lit_room_every_pixel_is_alike_and_bright():
    room = solved(
        box("room", [0, 0, 0], [1, 1, 1], inward=True, material=material("grey")),
        camera=camera([0.5, 0.5, 0.5], [1, 0.8, 0.6]),
    )
    picture = view.render_preview(room)
    assert picture.shape == (32, 32, 3)
    assert (
        picture.min() == picture.max() == 231
    )  # the 99th percentile is shown at 0.8: sRGB 1.055 * 0.8**(1/2.4) - 0.055


def test_faces_are_not_drawn_from_behind():
    plate = Surface.from_polygons("plate", material("grey"), [np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])])
    front = solved(plate, camera=camera([0.5, 0.5, 1], [0.5, 0.5, 0.01], fov_deg=20, up=[0, 1, 0]))
    behind = solved(plate, camera=camera([0.5, 0.5, -1], [0.5, 0.5, -0.01], fov_deg=20, up=[0, 1, 0]))
    assert view.render_preview(front).min() == 231
    assert 0 < view.render_preview(behind).max() < 60  # a dark grey background, but not black


def test_a_lamp_does_not_leave_the_room_in_the_dark():
    lamp = Surface.from_polygons(
        "lamp",
        material("lamp", emission=1000.0),
        [np.array([[0.2, 0.2, 0.99], [0.2, 0.8, 0.99], [0.8, 0.8, 0.99], [0.8, 0.2, 0.99]])],
    )
    room = box("room", [0, 0, 0], [1, 1, 1], inward=True, material=material("grey"))
    picture = view.render_preview(solved(room, lamp, camera=camera([0.5, 0.02, 0.5], [0.5, 1, 0.5], fov_deg=90)))
    assert np.median(picture) > 150
    assert picture.max() == 255


def test_the_picture_survives_a_move_far_away():
    eye, aim = np.array([0.5, 0.1, 0.5]), np.array([0.6, 1, 0.4])
    pictures = []
    for shift in (0.0, 1e5):
        room = box("room", [shift] * 3, [shift + 1] * 3, inward=True, material=material("grey"))
        case = solved(room, camera=camera(eye + shift, aim + shift), elements=150)
        case.radiosity = 0.2 + np.sin(3 * (case.mesh.element_centroid - shift)) ** 2
        pictures.append(view.render_preview(case).astype(int))
    assert pictures[0].std() > 10
    assert np.abs(pictures[0] - pictures[1]).max() <= 2


@pytest.mark.parametrize("bands", [1, 7])
def test_other_numbers_of_bands_get_a_colour_bar(bands):
    room = box("room", [0, 0, 0], [1, 1, 1], inward=True, material=material("grey", bands=bands))
    case = solved(room, camera=replace(camera([0.5, 0.5, 0.5], [1, 0.8, 0.6]), width=400, height=300))
    picture = view.render_preview(case)
    assert picture.shape == (300, 400 + 130, 3)
    assert (picture[:, -130:] == 255).all(axis=2).mean() > 0.5  # white paper round the bar
    assert (picture[:, -130:].max(axis=2) < 60).any()  # black letters on it


def test_background_light_is_shown():
    plate = Surface.from_polygons("plate", material("grey"), [np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])])
    away = camera([0.5, 0.5, 1], [0.5, 0.5, 2], up=[0, 1, 0])
    assert view.render_preview(solved(plate, camera=away, background=1.0)).min() == 255


def test_automatic_camera_looks_into_a_room_from_outside_and_into_a_house_from_inside():
    room = solved(box("room", [0, 0, 0], [2, 3, 1], inward=True, material=material("grey")))
    eye = view.automatic_camera(room.mesh, room.radiosity).eye
    assert (eye < [0, 0, 0]).any() or (eye > [2, 3, 1]).any()
    # With black walls outside there is nothing to see from there.
    house = solved(
        box("room", [0, 0, 0], [2, 3, 1], inward=True, material=material("grey")),
        box("walls", [-0.1, -0.1, -0.1], [2.1, 3.1, 1.1], inward=False, material=material("black", reflectance=0.0)),
    )
    eye = view.automatic_camera(house.mesh, house.radiosity).eye
    assert (eye > [0, 0, 0]).all() and (eye < [2, 3, 1]).all()
    for case in (room, house):
        lit = view.render_preview(case, 64, 48).max(axis=2) > 100
        assert lit.mean() > 0.25


def test_preview_file_is_whole(tmp_path):
    room = solved(
        box("room", [0, 0, 0], [1, 1, 1], inward=True, material=material("grey")),
        camera=replace(camera([0.5, 0.5, 0.5], [1, 0.8, 0.6]), width=3200, height=1600),
    )
    view.write_preview(room, tmp_path / "preview.png")
    assert Image.open(tmp_path / "preview.png").size == (800, 400)  # at most PREVIEW_SIDE
    assert [path.name for path in tmp_path.iterdir()] == ["preview.png"]


# ---- pyvista


def saved(folder):
    import pyvista

    mesh = pyvista.Plane(i_resolution=8, j_resolution=8)
    mesh.cell_data["radiosity_W_m2"] = np.linspace(0, 1, 64)[:, None] * [1.0, 2.0, 3.0]
    mesh.cell_data["emission_W_m2"] = np.zeros((64, 3))
    mesh.cell_data["surface_id"] = np.arange(64)
    mesh.save(folder / "solution.vtp")
    return folder


@pytest.mark.skipif(view.drawing_problem() is not None, reason=f"pyvista cannot draw: {view.drawing_problem()}")
def test_screenshot_shows_the_field_and_its_scale(tmp_path):
    view.write_screenshot(saved(tmp_path), tmp_path / "shot.png", size=(300, 260))
    picture = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB"))
    assert picture.shape == (260, 300, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 30
    view.write_screenshot(tmp_path, tmp_path / "ids.png", field="surface_id", size=(300, 260))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ids.png", "shot.png", "solution.vtp"]


def test_screenshot_refuses_what_it_cannot_do(tmp_path):
    with pytest.raises(OptionError, match="field: found 'colour', expected one of radiosity_W_m2, "):
        view.write_screenshot(saved(tmp_path), tmp_path / "shot.png", field="colour")
    with pytest.raises(OptionError, match=r"shot\.jpg: expected a name that ends in \.png"):
        view.write_screenshot(tmp_path, tmp_path / "shot.jpg")
    with pytest.raises(InputError, match=r"solution\.vtp: no such file; make it with 'radiosity solve"):
        view.write_screenshot(tmp_path / "empty", tmp_path / "shot.png")
    with pytest.raises(InputError, match=r"the folder .* does not exist"):
        view.write_screenshot(tmp_path, tmp_path / "absent" / "shot.png")


def test_without_egl_nothing_is_drawn_and_the_message_says_what_to_install(tmp_path, monkeypatch):
    def refuse(name, *rest):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(view.sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", refuse)
    with pytest.raises(MissingLibraryError, match=r"libEGL\.so\.1.*apt-get install libegl1 libgl1-mesa-dri"):
        view.write_screenshot(saved(tmp_path), tmp_path / "shot.png")
    assert not (tmp_path / "shot.png").exists()


def test_without_a_display_no_window_is_opened(tmp_path, monkeypatch):
    monkeypatch.setattr(view.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(MissingLibraryError, match=r"DISPLAY is not set.*--screenshot"):
        view.show(saved(tmp_path))
