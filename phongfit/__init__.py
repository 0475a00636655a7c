"""Fit the Phong illumination model to images, with honest error bars."""

from typing import Any

import lazy_loader

from .moved import MOVED, warn_deprecated

__version__ = "0.2.0"

# Public names are listed in `__init__.pyi` and imported at first use: JAX and decoders
# load slowly, and the help of a command needs neither.
_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_moved, _, _ = lazy_loader.attach(
    __name__, submod_attrs={module: names.split() for module, names in MOVED.items()}
)


def __getattr__(name: str) -> Any:
    for module, names in MOVED.items():
        if name in names.split():
            warn_deprecated(
                f"phongfit.{name} goes in 0.4; write from phongfit.{module} import "
                f"{name}"
            )
            return _moved(name)
    return _public(name)
