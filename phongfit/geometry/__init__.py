# `phongfit.shapes`, which the stub of phongfit names as a part of this package.
from phongfit.geometry import shapes as shapes
