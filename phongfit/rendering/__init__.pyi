"""Public names of the rendering beside those of `phongfit` itself."""

from .jpeg import JpegCompression as JpegCompression
from .pixels import PixelTerms as PixelTerms, pixel_terms as pixel_terms
from .terms import ShadingTerms as ShadingTerms, combine as combine
