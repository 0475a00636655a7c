"""Settings of the page's sliders: their names, units and limits.

The page is built from these fields, and the server validates requests by them.
"""

from typing import Annotated, Any, Literal

from pydantic import Field, Strict

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


WITH_LIGHT = {"light": ["directional", "point", "spot"]}
NEAR_LIGHT = {"light": ["point", "spot"]}
SPOT_LIGHT = {"light": ["spot"]}


class Settings(AbstractRecord):
    """Values of all sliders.

    The surface fits into a sphere of radius 1 around the origin; lengths are in that
    unit. Angles are in degrees: 0, 0 is straight from the front, along +z.
    """

    diffuse: Shares = _slider(
        "material", "diffuse", (0.6, 0.3, 0.2), symbol="ρ_d", step=0.01
    )
    specular: Shares = _slider(
        "material", "specular", (0.4, 0.4, 0.4), symbol="ρ_s", step=0.01
    )
    ambient: Shares = _slider(
        "material", "ambient", (0.6, 0.3, 0.2), symbol="ρ_a", step=0.01
    )
    shininess: float = _slider(
        "material", "exponent", 60.0, 1, 1000, symbol="f", step=0.1, scale="log"
    )

    light: Literal["none", "directional", "point", "spot"] = _slider(
        "light", "kind of light", "directional", words={"none": "ambient"}
    )
    azimuth: float = _slider(
        "light", "to the right", 35.0, -180, 180, unit="°", step=1, only=WITH_LIGHT
    )
    elevation: float = _slider(
        "light", "upwards", 30.0, -90, 90, unit="°", step=1, only=WITH_LIGHT
    )
    distance: float = _slider(
        "light",
        "distance",
        3.0,
        NEAREST,
        FURTHEST,
        unit="radii",
        step=0.1,
        scale="log",
        only=NEAR_LIGHT,
    )
    falloff: float = _slider(
        "light", "falls off with d²", 0.0, 0, 1, symbol="κ", step=0.01, only=NEAR_LIGHT
    )
    cutoff: float = _slider(
        "light", "half the cone", 14.0, 1, 90, unit="°", step=0.5, only=SPOT_LIGHT
    )
    exponent: float = _slider(
        "light", "spot exponent", 4.0, 0, 128, symbol="e", step=1, only=SPOT_LIGHT
    )
    intensity: Strengths = _slider(
        "light", "intensity", (1, 1, 1), symbol="I_s", step=0.05, only=WITH_LIGHT
    )
    ambient_light: float = _slider(
        "light", "ambient light", 0.3, 0, 1, symbol="I_a", step=0.01
    )

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
    turn: float = _slider(
        "view", "view from the right", 0.0, -180, 180, unit="°", step=1
    )
    tilt: float = _slider("view", "view from above", 0.0, -89, 89, unit="°", step=1)

    centre_x: float = _slider(
        "frame", "centre, from the left", 50.0, 0, 100, unit="%", step=0.1
    )
    centre_y: float = _slider(
        "frame", "centre, from the top", 50.0, 0, 100, unit="%", step=0.1
    )
    radius: float = _slider(
        "frame", "radius, of the height", 45.0, 1, 100, unit="%", step=0.1
    )


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


class FitOptions(AbstractRecord):
    """Options of a fit of a target."""

    loss: Literal["linear", "huber", "soft_l1", "cauchy", "tukey"] = _slider(
        "fit",
        "loss",
        "linear",
        words={
            "linear": "least squares",
            "huber": "Huber",
            "soft_l1": "soft L1",
            "cauchy": "Cauchy",
            "tukey": "Tukey",
        },
    )
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
