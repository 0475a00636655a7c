"""A live OpenGL context, through PyOpenGL, which draws what phongfit hands it."""

from typing import Any

import numpy as np

from experiments.opengl_scene import MAX_LIGHTS, camera_to_opengl, scene_to_opengl
from experiments.opengl_state import light_to_opengl
from phongfit.files.opengl import Parameters, material_to_opengl
from phongfit.geometry.meshes import Mesh
from phongfit.lights import AbstractLight
from phongfit.material import Material, unstack_materials
from phongfit.scene import Scene
from phongfit.textures import Texture


def _gl() -> Any:
    # Here, since it fixes its platform when it is first imported.
    import OpenGL.GL

    return OpenGL.GL


def apply_material(
    material: Material, face: str = "GL_FRONT_AND_BACK", *, nearest: bool = False
) -> None:
    """Set the material of what is drawn next.

    **Arguments:** `material`, `nearest`: as in [`material_to_opengl`][], which says
    what is raised; `face`: GL_FRONT, GL_BACK or both.
    """
    gl = _gl()
    for name, value in material_to_opengl(material, nearest=nearest).items():
        call = gl.glMaterialf if isinstance(value, float) else gl.glMaterialfv
        call(getattr(gl, face), getattr(gl, name), value)


def apply_light(light: AbstractLight, number: int, *, nearest: bool = False) -> None:
    """Set and switch on light `number`, from 0.

    The modelview matrix must be that of the camera alone: OpenGL applies it to the
    light's position. See [`light_to_opengl`][] for `nearest` and what is raised.
    """
    _set_light(_gl(), number, light_to_opengl(light, nearest=nearest))


def _set_light(gl: Any, number: int, parameters: Parameters) -> None:
    light = gl.GL_LIGHT0 + number
    # What a light does not have, the one before may have left behind.
    point = {
        "GL_CONSTANT_ATTENUATION": 1.0,
        "GL_LINEAR_ATTENUATION": 0.0,
        "GL_QUADRATIC_ATTENUATION": 0.0,
        "GL_SPOT_EXPONENT": 0.0,
        "GL_SPOT_CUTOFF": 180.0,
    }
    for name, value in (point | parameters).items():
        call = gl.glLightf if isinstance(value, float) else gl.glLightfv
        call(light, getattr(gl, name), value)
    gl.glEnable(light)


def apply_scene(
    scene: Scene, *, near: float = 0.1, far: float = 100.0, nearest: bool = False
) -> None:
    """Set camera, lights, light model, shade model, fog and clear colour.

    **Arguments:** `scene`, `nearest`: as in [`scene_to_opengl`][], which says what is
    raised; `near`, `far`: depths between which things are drawn, world units.
    """
    gl = _gl()
    state = scene_to_opengl(scene, nearest=nearest)
    projection, modelview = camera_to_opengl(scene.camera, near, far)
    gl.glMatrixMode(gl.GL_PROJECTION)
    gl.glLoadMatrixd(projection.T.copy())
    gl.glMatrixMode(gl.GL_MODELVIEW)
    gl.glLoadMatrixd(modelview.T.copy())
    gl.glEnable(gl.GL_LIGHTING)
    gl.glEnable(gl.GL_DEPTH_TEST)
    gl.glEnable(gl.GL_NORMALIZE)
    model = state["light_model"]
    gl.glLightModelfv(gl.GL_LIGHT_MODEL_AMBIENT, model["GL_LIGHT_MODEL_AMBIENT"])
    local = model["GL_LIGHT_MODEL_LOCAL_VIEWER"]
    gl.glLightModeli(gl.GL_LIGHT_MODEL_LOCAL_VIEWER, int(local))
    gl.glShadeModel(getattr(gl, state["shade_model"]))
    if bool(gl.glClampColor):
        gl.glClampColor(gl.GL_CLAMP_VERTEX_COLOR, int(state["clamp_vertex_color"]))
    for number in range(MAX_LIGHTS):
        gl.glDisable(gl.GL_LIGHT0 + number)
    for number, light in enumerate(state["lights"]):
        _set_light(gl, number, light)
    _set_fog(gl, state["fog"])
    gl.glClearColor(*state["background"], 1.0)


def _switch(gl: Any, what: Any, on: bool) -> None:
    (gl.glEnable if on else gl.glDisable)(what)


def _set_fog(gl: Any, fog: Parameters | None) -> None:
    _switch(gl, gl.GL_FOG, fog is not None)
    if fog is None:
        return
    gl.glHint(gl.GL_FOG_HINT, gl.GL_NICEST)
    gl.glFogi(gl.GL_FOG_MODE, getattr(gl, fog["GL_FOG_MODE"]))
    gl.glFogfv(gl.GL_FOG_COLOR, fog["GL_FOG_COLOR"])
    for name in ("GL_FOG_DENSITY", "GL_FOG_START", "GL_FOG_END"):
        gl.glFogf(getattr(gl, name), fog[name])


def draw_mesh(mesh: Mesh, material: Material, *, nearest: bool = False) -> None:
    """Draw a mesh, with one material or one for each of its `material_index`."""
    gl = _gl()
    vertices = np.asarray(mesh.vertices, np.float32)
    normals = np.asarray(mesh.vertex_normals(), np.float32)
    faces = np.asarray(mesh.faces, np.uint32)
    index = mesh.material_index
    owner = np.zeros(len(faces), int) if index is None else np.asarray(index)
    _switch(gl, gl.GL_CULL_FACE, not mesh.two_sided)
    gl.glLightModeli(gl.GL_LIGHT_MODEL_TWO_SIDE, int(mesh.two_sided))
    gl.glEnableClientState(gl.GL_VERTEX_ARRAY)
    gl.glEnableClientState(gl.GL_NORMAL_ARRAY)
    gl.glVertexPointer(3, gl.GL_FLOAT, 0, vertices)
    gl.glNormalPointer(gl.GL_FLOAT, 0, normals)
    for number, one in enumerate(unstack_materials(material, mesh.materials)):
        own = np.ascontiguousarray(faces[owner == number])
        apply_material(one, nearest=nearest)
        gl.glDrawElements(gl.GL_TRIANGLES, own.size, gl.GL_UNSIGNED_INT, own)
    gl.glDisableClientState(gl.GL_NORMAL_ARRAY)
    gl.glDisableClientState(gl.GL_VERTEX_ARRAY)


def draw_textured(mesh: Mesh, material: Material) -> None:
    """Draw a mesh of one material whose texture multiplies all but the highlight."""
    gl = _gl()
    assert mesh.textures is not None and mesh.uv is not None
    (textures,) = mesh.textures
    assert textures.diffuse is textures.ambient is textures.emission
    assert isinstance(textures.diffuse, Texture) and textures.specular is None
    _set_texture(gl, textures.diffuse)
    faces = np.asarray(mesh.faces)
    corners, normals, uv = (
        np.ascontiguousarray(values, np.float32)
        for values in (
            np.asarray(mesh.vertices)[faces].reshape(-1, 3),
            np.asarray(mesh.vertex_normals())[faces].reshape(-1, 3),
            np.asarray(mesh.uv).reshape(-1, 2),
        )
    )
    _switch(gl, gl.GL_CULL_FACE, not mesh.two_sided)
    states = gl.GL_VERTEX_ARRAY, gl.GL_NORMAL_ARRAY, gl.GL_TEXTURE_COORD_ARRAY
    for state in states:
        gl.glEnableClientState(state)
    gl.glVertexPointer(3, gl.GL_FLOAT, 0, corners)
    gl.glNormalPointer(gl.GL_FLOAT, 0, normals)
    gl.glTexCoordPointer(2, gl.GL_FLOAT, 0, uv)
    apply_material(material)
    gl.glDrawArrays(gl.GL_TRIANGLES, 0, len(corners))
    for state in states:
        gl.glDisableClientState(state)
    gl.glDisable(gl.GL_TEXTURE_2D)


def _set_texture(gl: Any, texture: Texture) -> None:
    # Row 0 is at v = 0 for both, whatever is called up.
    values = np.ascontiguousarray(texture.values, np.float32)
    rows, columns, channels = values.shape
    values = np.ascontiguousarray(np.broadcast_to(values, (rows, columns, 3)))
    filter = gl.GL_LINEAR if texture.filter == "bilinear" else gl.GL_NEAREST
    wrap = gl.GL_REPEAT if texture.wrap == "repeat" else gl.GL_CLAMP_TO_EDGE
    gl.glEnable(gl.GL_TEXTURE_2D)
    for name, value in (
        (gl.GL_TEXTURE_MIN_FILTER, filter),
        (gl.GL_TEXTURE_MAG_FILTER, filter),
        (gl.GL_TEXTURE_WRAP_S, wrap),
        (gl.GL_TEXTURE_WRAP_T, wrap),
    ):
        gl.glTexParameteri(gl.GL_TEXTURE_2D, name, value)
    gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
    size = 0, gl.GL_RGB32F, columns, rows, 0
    gl.glTexImage2D(gl.GL_TEXTURE_2D, *size, gl.GL_RGB, gl.GL_FLOAT, values)
    gl.glTexEnvi(gl.GL_TEXTURE_ENV, gl.GL_TEXTURE_ENV_MODE, gl.GL_MODULATE)
    # The highlight is added after the texture.
    separate = gl.GL_SEPARATE_SPECULAR_COLOR
    gl.glLightModeli(gl.GL_LIGHT_MODEL_COLOR_CONTROL, separate)
