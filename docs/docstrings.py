"""What a class says of its fields, where that is given to `__init__` afterwards."""

import importlib
import inspect

import griffe


class InitDocstrings(griffe.Extension):
    """Adds `Thing.__init__.__doc__ = …`, which reading the source does not see."""

    def on_class(self, *, cls, **_):
        if "__init__" in cls.members and cls.members["__init__"].docstring:
            return
        module = importlib.import_module(cls.module.path)
        found = getattr(module, cls.name, None)
        words = inspect.getdoc(getattr(found, "__init__", None)) or ""
        if cls.docstring and words.startswith("**Arguments:**"):
            fields = words.replace("**Arguments:**", "**Fields:**", 1)
            cls.docstring.value += "\n\n" + fields
