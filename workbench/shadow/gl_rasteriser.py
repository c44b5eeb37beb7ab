"""Many shadow cameras at once on graphics hardware: one atlas, one tile a point.

moderngl draws on EGL, so no window is needed; without a graphics card Mesa's llvmpipe does the work
on the processor.  Triangles come clipped and projected in double precision
(:func:`workbench.shadow.rasteriser.emit_tiles`), since single precision in a vertex shader loses
occluders close to the point.  The hardware fills them: the light into one channel of the image with
its depth, the occluders into another where they are nearer.  A pixel is counted once however often
it was drawn.

llvmpipe shares a picture among ``LP_NUM_THREADS`` threads; set it in the environment before the
first picture to change that.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.errors import MissingLibraryError

__all__ = ["GLRasteriser", "gl_renderer"]

_INSTALL = "use backend='software', or install Mesa (Debian: libegl1 libgl1 libgl1-mesa-dri)"

_VERTEX = """
#version 330
in vec3 place;  // place in the atlas, -1..1, and depth
out float depth;
void main() {
    depth = place.z;
    gl_Position = vec4(place.xy * place.z, 0.0, place.z);
}
"""

# Depth is written as a share of the light's distance: the depth that a projection makes would
# spend its digits near the point, where none are needed.
_FRAGMENT = """
#version 330
in float depth;
uniform float scale;
out vec4 mark;
void main() {
    mark = vec4(1.0);
    gl_FragDepth = clamp(depth * scale, 0.0, 1.0);
}
"""


@cache
def gl_renderer() -> str:
    """Name of the renderer that EGL offers, such as ``llvmpipe (LLVM 15.0.6, 256 bits)``.

    The libraries are probed one by one before a context is made, so that a machine without them
    gets an error, not a crash.

    Raises
    ------
    MissingLibraryError
        If EGL, OpenGL, moderngl or a device to draw on is absent.
    """
    if not sys.platform.startswith("linux"):
        raise MissingLibraryError(f"EGL: found platform {sys.platform}, expected Linux; use backend='software'")
    for name in ("EGL", "GL"):
        try:
            ctypes.CDLL(ctypes.util.find_library(name) or f"lib{name}.so.1")
        except OSError:
            raise MissingLibraryError(f"lib{name}: not found; {_INSTALL}") from None
    _probe_device(ctypes.CDLL(ctypes.util.find_library("EGL") or "libEGL.so.1"))
    try:
        import moderngl  # noqa: F401
    except ImportError:
        raise MissingLibraryError("moderngl: not found; pip install moderngl, or use backend='software'") from None
    try:
        context = _context()
    except Exception as error:  # moderngl raises plain Exception whatever is wrong
        raise MissingLibraryError(f"OpenGL 3.3 on EGL: {error}; {_INSTALL}") from None
    name = str(context.info["GL_RENDERER"])
    context.release()
    return name


def _context() -> Any:
    """A context of its own, without a window."""
    import moderngl

    settings: dict[str, Any] = {"standalone": True, "backend": "egl", "require": 330}
    return moderngl.create_context(**settings)


def _probe_device(egl: ctypes.CDLL) -> None:
    """Ask EGL for a device and initialise its display; raise MissingLibraryError if it has none."""
    platform_device = 0x313F
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    display_of = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query or not display_of:
        raise MissingLibraryError(f"libEGL: found no device enumeration; {_INSTALL}")
    device, count = ctypes.c_void_p(), ctypes.c_int(0)
    found = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query)(
        1, ctypes.byref(device), ctypes.byref(count)
    )
    if not found or count.value < 1:
        raise MissingLibraryError(f"libEGL: found no device to draw on; {_INSTALL}")
    display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(display_of)(
        platform_device, device, None
    )
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    if not display or not egl.eglInitialize(display, None, None):
        raise MissingLibraryError(f"libEGL: its device cannot be initialised; {_INSTALL}")


class GLRasteriser:
    """An atlas and the two passes that fill it; use it in one thread, as a ``with`` block.

    Parameters
    ----------
    atlas : int
        Side of the atlas in pixels.
    capacity : int
        Vertices that the buffer holds.

    Raises
    ------
    MissingLibraryError
        See :func:`gl_renderer`.
    """

    def __init__(self, atlas: int, capacity: int) -> None:
        self.renderer = gl_renderer()
        import moderngl

        self._gl = moderngl
        context = _context()
        self._context = context
        self._program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._colour = context.texture((atlas, atlas), 2, dtype="f1")
        self._target = context.framebuffer([self._colour], context.depth_texture((atlas, atlas)))
        self._picture = np.empty((atlas, atlas, 2), np.uint8)
        self._buffer = context.buffer(reserve=12 * capacity, dynamic=True)
        self._array = context.vertex_array(self._program, [(self._buffer, "3f", "place")])

    def __enter__(self) -> GLRasteriser:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.release()

    def draw(self, light: NDArray[np.float32], occluders: NDArray[np.float32], far: float, rows: int) -> NDArray:
        """Draw the light, then the occluders; (rows, atlas) uint8 of 0 no light, 1 visible, 2 blocked.

        ``light`` and ``occluders`` are (k, 3) vertices of triangles: place in the atlas and depth.
        The light's depths are multiplied by ``far`` before the occluders are compared with them.
        """
        gl = self._gl
        target, context = self._target, self._context
        target.color_mask = True, True, True, True
        target.depth_mask = True
        target.use()  # the masks take effect here
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        context.enable_only(gl.DEPTH_TEST)
        context.depth_func = "<"
        for vertices, scale, mask in (
            (light, far, (True, False, False, False)),
            (occluders, 1.0, (False, True, False, False)),
        ):
            if not len(vertices):
                continue
            target.color_mask = mask
            target.depth_mask = mask[0]
            target.use()
            self._program["scale"] = scale
            self._buffer.orphan()
            self._buffer.write(vertices)
            self._array.render(gl.TRIANGLES, vertices=len(vertices))
        target.read_into(self._picture, viewport=(0, 0, self._picture.shape[1], rows), components=2, alignment=1)
        picture = self._picture[:rows]
        return (picture[..., 0] > 0) * (1 + (picture[..., 1] > 0)).astype(np.uint8)
