"""Pictures of a solution: the preview that every solve leaves, and the door to pyvista.

The preview needs no OpenGL: the mesh is ray-cast with Embree and coloured by its interpolated
radiosity.  pyvista is opened only by :func:`show` and :func:`write_screenshot`, and only after the
system libraries it draws with were found: VTK without EGL or a display ends the whole process with
a segmentation fault, which no ``except`` can catch.

Faces seen from behind are not drawn, so that a closed room can be looked into from outside.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from radiosity.interpolation import corner_values
from workbench.errors import InputError, MissingLibraryError, OptionError
from workbench.render.camera import PinholeRays
from workbench.render.image import srgb_bytes, write_picture
from workbench.scene.model import Camera

if TYPE_CHECKING:
    from radiosity.patches import PatchMesh
    from radiosity.solvers.solution import Solution

__all__ = [
    "FIELDS",
    "automatic_camera",
    "drawing_problem",
    "render_preview",
    "show",
    "solution_camera",
    "window_problem",
    "write_preview",
    "write_screenshot",
]

FIELDS: dict[str, str] = {
    "radiosity_W_m2": "radiosity [W/m2]",
    "irradiance_W_m2": "irradiance [W/m2]",
    "emission_W_m2": "emission [W/m2]",
    "unshot_W_m2": "unshot radiosity [W/m2]",
    "reflectance": "reflectance",
    "surface_id": "surface number",
    "patch_id": "patch number",
    "element_id": "element number",
}
"""The cell arrays of ``solution.vtp`` and the title that each is shown with."""

INSTALL_EGL = "run 'apt-get install libegl1 libgl1-mesa-dri'"
"""libegl1 brings Mesa's EGL along; the software driver behind it, swrast, is in libgl1-mesa-dri."""

PREVIEW_SIDE = 800
"""Longest side of a preview whose size nobody asked for. [pixels]"""

_BACKGROUND = 0.03  # linear grey behind a scene without background light, so that black stays visible
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709


# ---- the preview ------------------------------------------------------------------------------


class _Caster:
    """Rays from one eye to the faces that look at it, in Embree's own scale."""

    def __init__(self, mesh: PatchMesh, eye: NDArray[np.float64]) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        counts = np.diff(mesh.piece_start) - 2
        first = np.repeat(mesh.piece_start[:-1], counts)
        step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        corner = np.stack([first, first + step + 1, first + step + 2], axis=1)
        element = np.repeat(mesh.piece_element, counts)
        towards = np.einsum("ij,ij->i", eye - mesh.corners[corner[:, 0]], mesh.element_normal[element])
        self.corner, self.element = corner[towards > 0], element[towards > 0]
        # Embree works in float32: move the scene to the origin and give it unit size.
        low, high = mesh.corners.min(axis=0), mesh.corners.max(axis=0)
        self.center, self.size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        self.eye = (eye - self.center) / self.size
        self.scene = None
        if len(self.corner):
            self.scene = EmbreeScene()
            TriangleMesh(self.scene, ((mesh.corners[self.corner] - self.center) / self.size).astype(np.float32))

    def cast(self, directions: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The triangle (r,) met by each ray, -1 for none, and the weights (r, 3) of its corners."""
        if self.scene is None:
            return np.full(len(directions), -1), np.zeros((len(directions), 3))
        start = max(0.0, float(np.linalg.norm(self.eye)) - 1.0)  # a far eye would cost float32 digits
        found = self.scene.run(
            (self.eye + directions * start).astype(np.float32), directions.astype(np.float32), output=True
        )
        u, v = found["u"].astype(np.float64), found["v"].astype(np.float64)
        return found["primID"].astype(np.int64), np.stack([1 - u - v, u, v], axis=1)


def _directions(camera: Camera, samples: int) -> NDArray[np.float64]:
    """Unit directions (height * samples * width * samples, 3) through a grid over each pixel."""
    y, x = np.meshgrid(
        (np.arange(camera.height * samples) + 0.5) / samples,
        (np.arange(camera.width * samples) + 0.5) / samples,
        indexing="ij",
    )
    return PinholeRays.from_camera(camera).directions(x.ravel(), y.ravel())


def automatic_camera(mesh: PatchMesh, radiosity: NDArray[np.float64], *, up: int = 2) -> Camera:
    """A camera that frames the whole mesh and sees as much lit surface as it can.

    Eight places around the scene are tried, above its middle; where less than a quarter of the
    picture shows lit surface from all of them (a room with an outside), four places inside its
    bounding box too.

    Parameters
    ----------
    mesh : PatchMesh
    radiosity : (n, bands) float
    up : int
        The axis that points up: 1 for y, 2 for z.
    """
    low, high = mesh.corners.min(axis=0), mesh.corners.max(axis=0)
    center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2 or 1.0
    points = mesh.corners - center
    upward = np.eye(3)[up]
    first, second = np.roll(np.eye(3), -up, axis=0)[1:]
    shine = radiosity.sum(axis=1)
    lit = shine > 0.02 * np.average(shine, weights=mesh.element_area)

    def lit_share(camera: Camera) -> float:
        caster = _Caster(mesh, camera.eye)
        triangle, _ = caster.cast(_directions(replace(camera, width=48, height=36), 1))
        return float(lit[caster.element[triangle[triangle >= 0]]].sum()) / triangle.size

    def camera_at(eye: NDArray[np.float64], fov_deg: float) -> Camera:
        return Camera(eye=eye, look_at=center, up=upward, fov_deg=fov_deg, width=640, height=480)

    outside = []
    half_height = np.tan(np.radians(40.0) / 2)
    for turn in np.radians([-60, -120, -30, -150, 60, 120, 30, 150]):
        away = np.cos(turn) * first + np.sin(turn) * second + 0.35 * upward
        away /= np.linalg.norm(away)
        right = np.cross(upward, away)
        right /= np.linalg.norm(right)
        # Each corner must lie inside the picture's edges: |offset| <= half_height * (distance - depth).
        offset = np.maximum(np.abs(points @ np.cross(away, right)), np.abs(points @ right) * 480 / 640)
        distance = float((offset / half_height + points @ away).max())
        outside.append(camera_at(center + away * (1.05 * distance + 1e-3 * radius), 40.0))
    shares = [lit_share(camera) for camera in outside]
    if max(shares) >= 0.25:
        return outside[int(np.argmax(shares))]
    corners = [(-0.84, -0.84), (0.84, -0.84), (-0.84, 0.84), (0.84, 0.84)]
    half = (high - low) / 2
    inside = [camera_at(center + half * (a * first + b * second + 0.5 * upward), 75.0) for a, b in corners]
    cameras = outside + inside
    shares += [lit_share(camera) for camera in inside]
    return cameras[int(np.argmax(shares))]


def solution_camera(solution: Solution) -> Camera:
    """The scene's own camera, or one found by :func:`automatic_camera`."""
    scene = solution.scene
    if scene.camera is not None:
        return scene.camera
    y_up = scene.path is not None and scene.path.suffix.lower() in {".obj", ".gz", ".glb", ".gltf"}
    return automatic_camera(solution.mesh, solution.radiosity, up=1 if y_up else 2)


def _white_level(luminance: NDArray[np.float64], emits: NDArray[np.bool_]) -> float:
    """The luminance shown as white: the 99th percentile of what is seen by reflected light is 0.8 of it.

    Where a few bright spots leave the rest in the dark it is lowered until the median is shown at
    6 % (a quarter of full brightness after the sRGB curve).
    """
    seen = luminance[~emits & (luminance > 0)]
    if not seen.size:
        seen = luminance[luminance > 0]
    if not seen.size:
        return 1.0
    return min(float(np.percentile(seen, 99)) / 0.8, float(np.median(seen)) / 0.06)


def render_preview(
    solution: Solution,
    width: int | None = None,
    height: int | None = None,
    *,
    camera: Camera | None = None,
    samples: int = 2,
) -> NDArray[np.uint8]:
    """The solution seen through a camera, by default that of :func:`solution_camera`.

    Three bands are shown as red, green and blue; any other number as the sum over the bands, with
    a colour bar added at the right.

    Parameters
    ----------
    solution : Solution
    width, height : int, optional
        Size without the bar; by default the camera's, at most :data:`PREVIEW_SIDE` a side. [pixels]
    camera : Camera, optional
    samples : int
        Rays a pixel along each side.

    Returns
    -------
    (height, width or more, 3) uint8
        sRGB, the top row first.
    """
    mesh = solution.mesh
    camera = camera if camera is not None else solution_camera(solution)
    if width is None or height is None:
        scale = min(1.0, PREVIEW_SIDE / max(camera.width, camera.height))
        width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    colour = mesh.emission.shape[1] == 3
    camera = replace(camera, width=width, height=height)
    caster = _Caster(mesh, np.asarray(camera.eye, dtype=np.float64))
    triangle, weights = caster.cast(_directions(camera, samples))
    hit = triangle >= 0
    corners = corner_values(mesh, solution.radiosity)
    if not colour:
        corners = corners.sum(axis=1, keepdims=True)
    seen = np.zeros((len(triangle), corners.shape[1]))
    for i in range(3):
        seen[hit] += weights[hit, i, None] * corners[caster.corner[triangle[hit], i]]
    emits = np.asarray(mesh.emission.any(axis=1))[caster.element[triangle[hit]]]
    luminance = seen[hit] @ _LUMINANCE if colour else seen[hit, 0]
    white = _white_level(luminance, emits)
    if not colour:
        return _with_colour_bar(seen[:, 0], hit, white, mesh.emission.shape[1], camera, samples)
    linear = np.minimum(seen / white, 1.0)
    background = np.asarray(solution.scene.background)
    if background.any():
        linear[~hit] = np.minimum(background * np.pi / white, 1.0)  # radiance to the same scale as radiosity
    else:
        linear[~hit] = _BACKGROUND
    return srgb_bytes(_average(linear, camera, samples))


def _average(samples_seen: NDArray[np.float64], camera: Camera, samples: int) -> NDArray[np.float64]:
    """Samples (rays, bands) averaged to pixels (height, width, bands)."""
    grid = samples_seen.reshape(camera.height, samples, camera.width, samples, -1)
    return grid.mean(axis=(1, 3))


def _with_colour_bar(
    seen: NDArray[np.float64],
    hit: NDArray[np.bool_],
    white: float,
    bands: int,
    camera: Camera,
    samples: int,
) -> NDArray[np.uint8]:
    """One number a sample as colours, with the scale at the right."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    mapping = ScalarMappable(Normalize(0.0, white, clip=True), colormaps["inferno"])
    colours = mapping.to_rgba(seen)[:, :3]
    colours[~hit] = 0.45  # grey: no colour of the scale
    picture = np.rint(_average(colours, camera, samples) * 255).astype(np.uint8)
    dpi = 100
    bar = 130  # pixels: room for the scale, its numbers and the label
    figure = Figure(figsize=(bar / dpi, camera.height / dpi), dpi=dpi, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    label = "radiosity [W/m$^2$]" if bands == 1 else f"radiosity, sum of {bands} bands [W/m$^2$]"
    axes = figure.add_axes((0.1, 0.06, 0.2, 0.88))
    figure.colorbar(mapping, cax=axes, label=label, extend="max")
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[: camera.height, :bar, :3]
    return np.ascontiguousarray(np.concatenate([picture, drawn], axis=1))


def write_preview(solution: Solution, path: str | Path, *, camera: Camera | None = None) -> None:
    """Write :func:`render_preview` as a PNG file, whole or not at all."""
    write_picture(path, render_preview(solution, camera=camera))


# ---- pyvista ----------------------------------------------------------------------------------


def drawing_problem() -> str | None:
    """Why pyvista cannot draw off-screen on this machine, with what to install, or ``None``.

    Does through ctypes what VTK does on Linux: load libEGL, list its devices, initialise one.  A
    failure here is the same failure that inside VTK would end the process.
    """
    if not sys.platform.startswith("linux"):
        return None  # macOS and Windows bring their own OpenGL
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return f"the EGL library (libEGL.so.1) is absent; {INSTALL_EGL}"
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query_address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    display_address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if query_address and display_address:
        pointer, integer = ctypes.c_void_p, ctypes.c_int
        query = ctypes.CFUNCTYPE(ctypes.c_uint, integer, ctypes.POINTER(pointer), ctypes.POINTER(integer))(
            query_address
        )
        get_display = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(display_address)
        egl.eglInitialize.argtypes = [pointer, pointer, pointer]
        egl.eglTerminate.argtypes = [pointer]
        devices, found = (pointer * 16)(), integer(0)
        if query(16, devices, ctypes.byref(found)):
            for device in devices[: found.value]:
                display = get_display(0x313F, device, None)  # EGL_PLATFORM_DEVICE_EXT
                if display and egl.eglInitialize(display, None, None):
                    egl.eglTerminate(display)
                    return None
    return f"EGL is there but no driver of it starts; {INSTALL_EGL}"


def window_problem() -> str | None:
    """Why no window can be opened on this machine, or ``None``."""
    if not sys.platform.startswith("linux"):
        return None
    if not os.environ.get("DISPLAY"):
        return "no display (DISPLAY is not set)"
    try:
        x11 = ctypes.CDLL("libX11.so.6")
        ctypes.CDLL("libGL.so.1")
    except OSError as error:
        return f"a library is absent ({error}); run 'apt-get install libx11-6 libgl1 libgl1-mesa-dri'"
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XOpenDisplay.argtypes = [ctypes.c_char_p]
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    display = x11.XOpenDisplay(None)
    if not display:
        return f"the display {os.environ['DISPLAY']!r} does not answer"
    x11.XCloseDisplay(display)
    return None


def _plotter(directory: Path, field: str, *, off_screen: bool, size: tuple[int, int] | None) -> Any:
    """A pyvista plotter that holds one field of a saved solution."""
    if field not in FIELDS:
        raise OptionError(f"field: found {field!r}, expected one of {', '.join(FIELDS)}")
    path = directory / "solution.vtp"
    if not path.is_file():
        raise InputError(f"{path}: no such file; make it with 'radiosity solve SCENE -o {directory}'")
    if off_screen:
        problem = drawing_problem()
        if problem is not None:
            raise MissingLibraryError(f"cannot draw with pyvista: {problem}; preview.png is drawn without it")
        # Without a display VTK would first try X and warn about it.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    import pyvista

    mesh = pyvista.read(path)
    if field not in mesh.cell_data:
        raise InputError(f"{path}: cell array {field!r} is missing; solve the scene again")
    values = np.asarray(mesh.cell_data[field], dtype=np.float64)
    title = FIELDS[field]
    if values.ndim == 2:
        if values.shape[1] > 1:
            name, bracket, unit = title.partition(" [")
            kind = "mean" if field == "reflectance" else "sum"
            values = getattr(values, kind)(axis=1)
            title = f"{name}, {kind} over the bands{bracket}{unit}"
        else:
            values = values[:, 0]
    limits = [float(values.min()), float(values.max())] if len(values) else [0.0, 1.0]
    bar: dict[str, Any] = {}
    scale_options = {
        "title": title,
        "color": "white",
        "title_font_size": 18,
        "label_font_size": 16,
        "n_labels": 5,
        "fmt": "%.4g",
        "width": 0.7,
        "height": 0.12,
        "position_x": 0.15,
        "position_y": 0.02,
    }
    if field in ("radiosity_W_m2", "irradiance_W_m2", "unshot_W_m2"):
        # A lamp is far brighter than what it lights: the scale is for the latter, brighter is white.
        emission = np.asarray(mesh.cell_data["emission_W_m2"]).reshape(len(values), -1)
        dark = values[~emission.any(axis=1)]
        top = float(np.percentile(dark, 99)) if len(dark) else 0.0
        if top > 0:
            limits, bar = [0.0, top], {"above_color": "white"}
            scale_options["above_label"] = ""
    mesh.clear_data()
    mesh.cell_data["shown"] = values
    camera = _recorded_camera(directory / "record.json")
    if size is None:  # the camera's own shape, 900 pixels wide
        size = (900, round(900 * camera["height"] / camera["width"]) if camera else 720)
    plotter: Any = pyvista.Plotter(off_screen=off_screen, window_size=list(size), title=f"{directory}: {title}")
    plotter.set_background("#40444a")
    plotter.add_mesh(
        mesh,
        scalars="shown",
        clim=limits,
        cmap="inferno" if field.endswith("_W_m2") else "viridis",
        lighting=False,
        culling="back",
        scalar_bar_args=scale_options,
        **bar,
    )
    # A dark plate, so that the letters can be read over any surface; pyvista's own option draws it white.
    scale = plotter.scalar_bars[title]
    scale.SetDrawBackground(True)
    scale.GetBackgroundProperty().SetColor(0.13, 0.13, 0.13)
    if camera:
        plotter.camera_position = [camera["eye"], camera["look_at"], camera["up"]]
        plotter.camera.view_angle = camera["fov_deg"]
        plotter.reset_camera_clipping_range()
    else:
        plotter.view_isometric()
    return plotter


def _recorded_camera(record: Path) -> dict[str, Any] | None:
    """The camera that the record keeps, or ``None``."""
    try:
        return json.loads(record.read_text(encoding="utf-8"))["settings"]["camera"]
    except (OSError, ValueError, KeyError):
        return None


def write_screenshot(
    directory: str | Path, path: str | Path, *, field: str = "radiosity_W_m2", size: tuple[int, int] | None = None
) -> None:
    """Draw one field of a saved solution with pyvista, off-screen, into a PNG file.

    Parameters
    ----------
    directory : str or Path
        The folder that ``radiosity solve`` wrote.
    path : str or Path
        The picture; its name ends in ``.png``.
    field : str
        One of :data:`FIELDS`; of several bands the sum is shown, of reflectances the mean.
    size : (width, height) int, optional
        By default 900 pixels wide, in the shape of the camera's picture. [pixels]

    Raises
    ------
    MissingLibraryError
        If the machine cannot draw; says what to install.
    OptionError
        If the field is unknown or the name does not end in ``.png``.
    InputError
        If the folder holds no solution or the picture cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OptionError(f"{path}: expected a name that ends in .png")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; make it first")
    plotter = _plotter(Path(directory), field, off_screen=True, size=size)
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part.png")  # pyvista wants the suffix
    try:
        plotter.screenshot(str(beside))
        beside.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        plotter.close()
        beside.unlink(missing_ok=True)


def show(directory: str | Path, *, field: str = "radiosity_W_m2") -> None:
    """Open one field of a saved solution in a window and wait until it is closed.

    Raises
    ------
    MissingLibraryError
        If no window can be opened.
    OptionError, InputError
        As :func:`write_screenshot`.
    """
    problem = window_problem()
    if problem is not None:
        raise MissingLibraryError(f"no window can be opened: {problem}; draw into a file with --screenshot FILE.png")
    _plotter(Path(directory), field, off_screen=False, size=None).show()
