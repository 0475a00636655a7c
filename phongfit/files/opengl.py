"""A material for the fixed-function OpenGL: its parameters, and as lines of C.

??? cite "Source"
    Segal and Akeley, *The OpenGL graphics system, version 1.5*, section 2.14.
"""

import os
import re
from typing import Any

import numpy as np

from phongfit.files.limits import colour, exponent
from phongfit.files.outputs import replacing
from phongfit.material import Material

Parameters = dict[str, Any]
"""Numbers by OpenGL's names."""

MAX_SHININESS = 128.0
FORMAT = "OpenGL"
HEAD = """/* {name}: a material of the Blinn-Phong model, by phongfit.

   Colours are linear light. The scene's ambient light is GL_LIGHT_MODEL_AMBIENT. */

#include <GL/gl.h>
"""


def rgba(rgb: Any) -> list[float]:
    """A colour with alpha 1, as plain numbers."""
    return [*(float(channel) for channel in np.asarray(rgb)), 1.0]


def material_to_opengl(material: Material, *, nearest: bool = False) -> Parameters:
    """A material as the arguments of `glMaterialfv` and `glMaterialf`.

    OpenGL's highlight is that of [`BlinnPhong`][]: convert an exponent that was fitted
    with [`Phong`][] by [`blinn_from_phong`][] first.

    **Arguments:**

    - `material`: a single one; split stacked materials with [`unstack_materials`][].
    - `nearest`: replace values that OpenGL cannot hold by the nearest, with a warning:
        an exponent above 128, or one for each channel.

    **Returns:** GL_AMBIENT, GL_DIFFUSE, GL_SPECULAR, GL_EMISSION: RGBA; GL_SHININESS.

    **Raises:** `ValueError` that names the parameter, unless `nearest`.
    """
    return {
        "GL_AMBIENT": rgba(colour("ambient", material.ambient)),
        "GL_DIFFUSE": rgba(colour("diffuse", material.diffuse)),
        "GL_SPECULAR": rgba(colour("specular", material.specular)),
        "GL_EMISSION": rgba(colour("emission", material.emission)),
        "GL_SHININESS": exponent(material, MAX_SHININESS, FORMAT, nearest),
    }


def opengl_lines(name: str, material: Material, *, nearest: bool = False) -> str:
    """The text of a C function that sets the current material.

    **Arguments:** `nearest`: as in [`material_to_opengl`][].

    **Raises:** `ValueError` that names the parameter, unless `nearest`.
    """
    parameters: Parameters = material_to_opengl(material, nearest=nearest)
    # The name must not end the comment early, and must be a valid identifier.
    word = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "material"
    lines = [HEAD.format(name=word), f"static void set_material_{word}(void)", "{"]
    colours = {key: value for key, value in parameters.items() if key != "GL_SHININESS"}
    for key, value in colours.items():
        variable = key.removeprefix("GL_").lower()
        numbers = ", ".join(_c_float(number) for number in value)
        lines.append(f"    static const GLfloat {variable}[4] = {{{numbers}}};")
    lines.append("")
    for key in colours:
        variable = key.removeprefix("GL_").lower()
        lines.append(f"    glMaterialfv(GL_FRONT_AND_BACK, {key}, {variable});")
    shininess = _c_float(parameters["GL_SHININESS"])
    lines.append(f"    glMaterialf(GL_FRONT_AND_BACK, GL_SHININESS, {shininess});")
    return "\n".join([*lines, "}", ""])


def _c_float(number: float) -> str:
    # The fewest digits that round to the same GLfloat.
    text = str(np.float32(number))
    return f"{text}f" if re.search("[.e]", text) else f"{text}.0f"


def write_opengl(
    path: str | os.PathLike[str],
    name: str,
    material: Material,
    *,
    nearest: bool = False,
) -> None:
    """Write the C function of [`opengl_lines`][] to a file, whole or not at all.

    **Raises:** `ValueError` as [`opengl_lines`][] does, `OSError` that names the file.
    """
    text = opengl_lines(name, material, nearest=nearest)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
