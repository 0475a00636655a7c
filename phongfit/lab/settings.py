"""Settings of the page's sliders: their names, units and limits.

The page is built from these fields, and the server validates requests by them.
"""

import functools
from typing import Annotated, Any, Literal

from pydantic import Field, Strict

from phongfit.files.fits import LossName
from phongfit.files.records import AbstractRecord
from phongfit.presets import OPENGL_MATERIALS

SPHERE = "sphere"
NEAREST, FURTHEST = 1.2, 100
"""Range of distances of near lamps, in radii of the ball; at the largest distance light
is parallel to within 0.6°."""

Group = Literal["material", "light", "model", "view", "frame", "fit"]
Share = Annotated[float, Field(ge=0, le=1)]
Strength = Annotated[float, Field(ge=0, le=10)]
# Not strict, since JSON has lists instead of tuples.
Shares = Annotated[tuple[Share, Share, Share], Strict(False)]
Strengths = Annotated[tuple[Strength, Strength, Strength], Strict(False)]


def _slider(
    group: Group,
    title: str,
    default: Any,
    lowest: float | None = None,
    highest: float | None = None,
    **more: Any,
) -> Any:
    """A field with the properties of its control on the page.

    **Arguments:**

    - `group`: section of the page; `title`: label of the control.
    - `lowest`, `highest`: limits of a number; the type of a colour has its limits.
    - `more`: `symbol`; `unit`; `step` of the slider; `scale`, "log" for a logarithmic
        one; `words`: labels of choices; `only`: values of other settings that this
        setting requires to have an effect.
    """
    return Field(
        default,
        ge=lowest,
        le=highest,
        title=title,
        json_schema_extra={"group": group, **more},
    )


# Properties that sliders share: units and steps, and the lights that they belong to.
DEGREES: dict[str, Any] = {"unit": "°", "step": 1}
PERCENT: dict[str, Any] = {"unit": "%", "step": 0.1}
LOGARITHMIC: dict[str, Any] = {"scale": "log", "step": 0.1}
_colour = functools.partial(_slider, "material", step=0.01)
_light = functools.partial(_slider, "light")
_lit = functools.partial(_light, only={"light": ["directional", "point", "spot"]})
_near = functools.partial(_light, only={"light": ["point", "spot"]})
_spot = functools.partial(_light, only={"light": ["spot"]})
_frame = functools.partial(_slider, "frame", **PERCENT)


class Settings(AbstractRecord):
    """Values of all sliders.

    The surface fits into a sphere of radius 1 around the origin; lengths are in that
    unit. Angles are in degrees: 0, 0 is straight from the front, along +z.
    """

    diffuse: Shares = _colour("diffuse", (0.6, 0.3, 0.2), symbol="ρ_d")
    specular: Shares = _colour("specular", (0.4, 0.4, 0.4), symbol="ρ_s")
    ambient: Shares = _colour("ambient", (0.6, 0.3, 0.2), symbol="ρ_a")
    shininess: float = _slider(
        "material", "exponent", 60.0, 1, 1000, symbol="f", **LOGARITHMIC
    )

    light: Literal["none", "directional", "point", "spot"] = _light(
        "kind of light", "directional", words={"none": "ambient"}
    )
    azimuth: float = _lit("to the right", 35.0, -180, 180, **DEGREES)
    elevation: float = _lit("upwards", 30.0, -90, 90, **DEGREES)
    distance: float = _near(
        "distance", 3.0, NEAREST, FURTHEST, unit="radii", **LOGARITHMIC
    )
    falloff: float = _near("falls off with d²", 0.0, 0, 1, symbol="κ", step=0.01)
    cutoff: float = _spot("half the cone", 14.0, 1, 90, unit="°", step=0.5)
    exponent: float = _spot("spot exponent", 4.0, 0, 128, symbol="e", step=1)
    intensity: Strengths = _lit("intensity", (1, 1, 1), symbol="I_s", step=0.05)
    ambient_light: float = _light("ambient light", 0.3, 0, 1, symbol="I_a", step=0.01)

    specular_model: Literal["blinn-phong", "phong"] = _slider(
        "model",
        "highlight",
        "blinn-phong",
        words={"blinn-phong": "Blinn", "phong": "Phong"},
    )
    shading: Literal["flat", "gouraud", "phong"] = _slider(
        "model", "shading", "phong", words={"gouraud": "Gouraud", "phong": "Phong"}
    )

    surface: str = Field(default=SPHERE, max_length=64, title="surface")
    turn: float = _slider("view", "view from the right", 0.0, -180, 180, **DEGREES)
    tilt: float = _slider("view", "view from above", 0.0, -89, 89, **DEGREES)

    centre_x: float = _frame("centre, from the left", 50.0, 0, 100)
    centre_y: float = _frame("centre, from the top", 50.0, 0, 100)
    radius: float = _frame("radius, of the height", 45.0, 1, 100)


def matters(settings: Settings) -> list[str]:
    """Names of the settings that affect the picture of a synthetic target."""

    def does(name: str) -> bool:
        about: Any = Settings.model_fields[name].json_schema_extra or {}
        if about.get("group") == "frame":
            return False
        if about.get("group") == "view":
            return settings.surface != SPHERE
        only = about.get("only", {}).items()
        return all(getattr(settings, other) in values for other, values in only)

    return [name for name in Settings.model_fields if does(name)]


LOSS_WORDS = {
    "linear": "least squares",
    "huber": "Huber",
    "soft_l1": "soft L1",
    "cauchy": "Cauchy",
    "tukey": "Tukey",
}


class FitOptions(AbstractRecord):
    """Options of a fit of a target."""

    loss: LossName = _slider("fit", "loss", "linear", words=LOSS_WORDS)
    rim: float = _slider("fit", "rim left out: n·v below", 0.0, 0, 0.9, step=0.01)
    light_too: bool = _slider(
        "fit", "the light's direction or position is unknown too", False
    )


class PictureRequest(AbstractRecord):
    """Request for a picture of the settings, in the target's frame."""

    settings: Settings
    target: str | None = Field(default=None, max_length=64)


class TargetRequest(AbstractRecord):
    """Request for a target made from the settings.

    `noise` is a standard deviation in linear light where white is 1.
    """

    settings: Settings
    noise: float = Field(default=0.01, ge=0, le=0.5)
    seed: int = Field(default=0, ge=0, lt=2**32)


class ChosenRequest(AbstractRecord):
    """Request for one of the photographs given to the command, as the target."""

    number: int = Field(ge=0)


class FitRequest(AbstractRecord):
    """Request for a fit of a target under the light and model of the settings."""

    settings: Settings
    target: str = Field(max_length=64)
    options: FitOptions = FitOptions()


def describe_settings() -> dict[str, Any]:
    """Data from which the page is built: fields with limits and words, and presets."""
    names = ("ambient", "diffuse", "specular", "shininess")
    return {
        "settings": Settings.model_json_schema()["properties"],
        "options": FitOptions.model_json_schema()["properties"],
        "noise": TargetRequest.model_json_schema()["properties"]["noise"],
        "presets": {
            name: dict(zip(names, numbers, strict=True))
            for name, numbers in OPENGL_MATERIALS.items()
        },
    }
