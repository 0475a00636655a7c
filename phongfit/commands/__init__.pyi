"""One module for each command."""

from . import (
    calibrate as calibrate,
    export as export,
    fit as fit,
    lab as lab,
    maps as maps,
    predict as predict,
    relight as relight,
    render as render,
    response as response,
    scene as scene,
    synth as synth,
    view as view,
)
