"""Fit the Phong illumination model to images, with honest error bars."""

import lazy_loader

__version__ = "0.1.0"

# The names stand in `__init__.pyi`. What one needs is imported when it is first asked
# for: JAX and decoders take long, and help on a command needs none of them.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
