"""Fit the Phong illumination model to images, with honest error bars."""

import lazy_loader

__version__ = "0.2.0"

# Public names are listed in `__init__.pyi` and imported at first use: JAX and decoders
# load slowly, and the help of a command needs neither.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
