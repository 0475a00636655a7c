"""Objects show themselves by way of `phongfit.report`, loaded when it is first wanted.

`fit.plot()` and a notebook's `_repr_html_` are asked of the object, but how it looks is
no part of it: the report knows the object, and the object knows only that there is one.
"""

import importlib
from typing import Any


def report(module: str) -> Any:
    """A module of `phongfit.report`; matplotlib and jinja2 come with it."""
    return importlib.import_module(f"phongfit.report.{module}")
