"""All situations of the experiment on honesty, by theme."""

from experiments.honesty.situations import (
    captures,
    derived,
    edges,
    jpeg,
    losses,
    maps,
    models,
    noise,
    unknowns,
    wrong,
)
from experiments.honesty.situations.base import Situation

THEMES = {
    "models": models,
    "noise": noise,
    "edges": edges,
    "losses": losses,
    "wrong models": wrong,
    "JPEG": jpeg,
    "unknowns": unknowns,
    "maps": maps,
    "captures": captures,
    "predictions and profiles": derived,
}


def all_situations() -> list[Situation]:
    """All situations, theme after theme."""
    return [one for theme in THEMES.values() for one in theme.situations()]
