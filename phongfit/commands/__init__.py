"""The commands, each imported when it runs: JAX and decoders take long to import."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
