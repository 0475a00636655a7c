"""The solution of a fit: search, edges, and the correction for JPEG."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

from phongfit.fitting.problem.posing import FitData
from phongfit.fitting.problem.samples import Source, gather, seen_pixels
from phongfit.fitting.solve.edges import keep_off_edges
from phongfit.fitting.solve.guesses import guess_places, look, moves_lights
from phongfit.fitting.solve.jpeg import Drawn, restore
from phongfit.fitting.solve.search import SearchResult, search
from phongfit.fitting.solve.solution import polish
from phongfit.fitting.solve.start import choose_few


class Minimum(NamedTuple):
    """The solution of a fit, and the images as they were compared with the model.

    - `sources`: the images, with weight 0 at moving edges, corrected for JPEG.
    - `at_edges`: warnings about pixels at moving edges.
    - `drawn`: sums over tiles of simulated residuals: see [`find_misfit`][].
    """

    found: SearchResult
    sources: list[Source]
    at_edges: tuple[str, ...] = ()
    drawn: Sequence[Drawn] | None = None


def find_minimum(data: FitData) -> Minimum:
    """Minimise the cost of samples and priors."""
    unknowns, sources, asked = data.unknowns, data.sources, data.specification
    seen, loss = seen_pixels(sources), asked.loss
    guesses = bright = None
    if moves_lights(unknowns):
        looks = [look(*one) for one in zip(sources, seen, strict=True)]
        guesses = guess_places(unknowns, looks, sources)
        bright = [one.excess for one in looks]
    few = choose_few(sources, seen, loss.robust, bright)
    how = data.noise_given, asked.max_steps
    first = search(
        None if few is None else gather(sources, few),
        lambda: gather(sources, seen),
        unknowns,
        loss,
        data.films[0].clamp,
        *how,
        guesses,
        asked.tolerance,
    )
    found, sources, at_edges = keep_off_edges(first, sources, seen, *how)
    drawn = None
    if any(film.jpeg is not None for film in data.films):
        found, sources, drawn = restore(found, sources, data.films, *how, data.side)
    polished = polish(found.problem, found.y)
    found = dataclasses.replace(found, y=polished, rival=first.rival)
    return Minimum(found, sources, at_edges, drawn)
