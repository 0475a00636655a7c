"""Make [`Unknowns`][] from a specification: bounds, fixed values, ties, priors."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from phongfit.checks import as_covariance
from phongfit.edge import shown
from phongfit.fitting.problem.charts import nearest_rotation, tangents
from phongfit.fitting.problem.parameters import (
    DEFAULT_BOUNDS,
    MATERIAL_PARAMETERS,
    Parameter,
    is_of_model,
    is_of_scene,
    list_entries,
    parameter,
    scene_arrays,
)
from phongfit.fitting.problem.shapes import moves_cosine
from phongfit.fitting.problem.specification import Specification, Tie, as_names
from phongfit.fitting.problem.unknowns import Unknowns
from phongfit.material import Material
from phongfit.scene import Scene

SINGULAR = 1e-6
"""Variance of a combination, relative to the mean, below which it counts as 0."""
FLOOR, HELD = 1e-5, 1e-6
"""Least variance of combinations of nuisances, relative to the mean, and least standard
deviation of a nuisance, relative to its size."""


def make_unknowns(
    specification: Specification, materials: int = 1, scenes: Sequence[Scene] = ()
) -> Unknowns:
    """The unknowns of a fit, checked; each of `materials` materials has its own.

    **Raises:** `ValueError` that names the argument and the entry that is wrong.
    """
    bounds, fixed, ties = (
        getattr(specification, name) for name in ("bounds", "fixed", "ties")
    )
    # By default all known reflectances are 0.
    known = specification.known
    known = Material(0.0, 0.0, 32.0, 0.0) if known is None else known
    parameters = _parameters(specification, known, materials, scenes)
    parameters += _nuisances(specification, scenes)
    names = _Names(parameters)
    table, size = names.table, len(names.table.label)
    first = first_values(parameters, scenes)
    factor, offset, is_fixed, source = _held(names, fixed, ties)
    own = (np.arange(size) == source) & ~is_fixed
    nuisance = table.nuisance
    if not (own & ~nuisance).any():
        raise ValueError("fixed: nothing unknown is left")

    low, high = _boxes(names, bounds, is_fixed)
    low, high = _narrowed(names, low, high, factor, source)
    low, high = np.where(nuisance, -np.inf, low), np.where(nuisance, np.inf, high)
    _check_fixed(names, offset, is_fixed, ties)
    scale = _scales(parameters, first)
    logarithm, direction = table.form == "logarithm", table.form == "direction"
    with np.errstate(divide="ignore"):
        low, high = (
            np.where(logarithm, np.log(np.where(logarithm, e, 1)), e / scale)
            for e in (low, high)
        )
    start = np.where(direction | logarithm, 0, first / scale)
    y_index, taken = np.zeros(size, int), 0
    own_entries = []
    for entry in np.flatnonzero(own):
        if direction[entry] and table.part[entry] > 0:
            y_index[entry] = y_index[entry - 1]
            continue
        y_index[entry] = taken
        count = 2 if direction[entry] else 1
        own_entries += [entry] * count
        taken += count
    mean, deviation, has_prior, root = _priors(
        names, specification, first, scale, is_fixed
    )
    base = first[direction].reshape(-1, 3)
    base = base / np.maximum(np.linalg.norm(base, axis=1, keepdims=True), 1e-30)
    kind = jnp.result_type(float)
    # One transfer to the device for all arrays, since each takes time.
    arrays = jax.device_put(
        {
            name: values.astype(kind)
            for name, values in dict(
                factor=factor,
                offset=offset,
                scale=scale,
                base=base,
                across=tangents(base),
                turn=_rotations(parameters, scenes),
                prior_mean=mean,
                prior_deviation=deviation,
                prior_root=root,
                start=np.clip(start, low, high)[own_entries],
                lower=low[own_entries],
                upper=high[own_entries],
            ).items()
        }
    )
    return Unknowns(
        parameters=parameters,
        materials=materials,
        images=max(len(scenes), 1),
        entry_of_y=tuple(int(entry) for entry in own_entries),
        source=tuple(source.tolist()),
        y_index=tuple(y_index.tolist()),
        fixed=tuple(is_fixed.tolist()),
        has_prior=tuple(has_prior.tolist()),
        relights=_relights(parameters, scenes),
        known=known,
        **arrays,
    )


def _relights(parameters: tuple[Parameter, ...], scenes: Sequence[Scene]) -> bool:
    """Whether an unknown changes more than the heights of lobes."""
    names = [one.name for one in parameters if is_of_scene(one.name)]
    if not all(map(is_of_model, names)):
        return True
    return bool(names) and moves_cosine(scenes[0].specular_model)


class _Names:
    """Indices of entries, by the names of parameters or entries."""

    def __init__(self, parameters: tuple[Parameter, ...]):
        self.table = list_entries(parameters)
        self._of: dict[str, list[int]] = {}
        parts = [part for one in parameters for _ in one.rows for part in one.parts]
        columns = zip(*self.table[::2][:2], parts, strict=True)
        for entry, (label, name, part) in enumerate(columns):
            for own in {str(name), label.removesuffix(part), str(label)}:
                self._of.setdefault(own, []).append(entry)

    def entries(self, argument: str, name: str) -> np.ndarray:
        """Indices of the entries with this name; `ValueError` for other names.

        Nuisances have a name only in `uncertain`.
        """
        found = self._of.get(name)
        nuisance = self.table.nuisance
        if found is None or (argument != "uncertain" and nuisance[found[0]]):
            known = (self.table.parameter[~nuisance], self.table.label[~nuisance])
            there = ", ".join(dict.fromkeys(np.concatenate(known).tolist()))
            raise ValueError(f"{argument}: expected one of {there}, got {name!r}")
        return np.array(found)

    def numbers(self, argument: str, name: str, given: Any) -> np.ndarray:
        """Numbers for all entries of a name; one number stands for all of them."""
        entries = self.entries(argument, name)
        try:
            values = np.broadcast_to(np.asarray(given, float).ravel(), entries.shape)
        except Exception as error:
            wanted = f"expected {len(entries)} numbers"
            raise ValueError(
                f"{argument}: {name}: {wanted}, got {shown(given)}"
            ) from error
        if not np.all(np.isfinite(values)):
            raise ValueError(f"{argument}: {name}: {shown(given)} is not finite")
        return values


def _parameters(
    asked: Specification, known: Material, materials: int, scenes: Sequence[Scene]
) -> tuple[Parameter, ...]:
    rows = () if materials == 1 else ((materials, 1), (materials, 3))
    for name in MATERIAL_PARAMETERS:
        shape = getattr(known, name).shape
        if shape not in ((), (1,), (3,), *rows):
            wanted = " or ".join(map(str, ((), (3,), *rows)))
            raise ValueError(f"known: {name}: expected shape {wanted}, got {shape}")
    # In the order of the printed table, not in that of the argument.
    ordered = [name for name in MATERIAL_PARAMETERS if name in asked.unknowns]
    ordered += [name for name in asked.unknowns if name not in MATERIAL_PARAMETERS]
    parameters = tuple(
        parameter(
            name,
            name in asked.per_channel,
            materials,
            scenes,
            name in asked.per_image,
        )
        for name in ordered
    )
    for entry in parameters:
        if is_of_scene(entry.name) and not entry.per_image:
            arrays = [np.asarray(scene_arrays(scene)[entry.name]) for scene in scenes]
            if any(not np.array_equal(array, arrays[0]) for array in arrays):
                raise ValueError(
                    f"unknowns: {entry.name} differs between the scenes; name it in "
                    "per_image as well, or start all from the same"
                )
    return parameters


def _nuisances(asked: Specification, scenes: Sequence[Scene]) -> tuple[Parameter, ...]:
    """The uncertain arrays that are not among the unknowns, one for each image."""
    return tuple(
        dataclasses.replace(
            parameter(name, True, 1, scenes, not is_of_model(name)), nuisance=True
        )
        for name in asked.uncertain_arrays
        if name not in asked.unknowns
    )


def first_values(
    parameters: tuple[Parameter, ...],
    scenes: Sequence[Scene],
    material: Material | None = None,
) -> np.ndarray:
    """Values of all entries in the scenes and the material; 1 where they have none."""
    values = []
    for one in parameters:
        size = (len(one.rows), len(one.parts))
        given_values = np.ones(())
        if one.form == "rotation":
            # Angles are relative to the scene's rotation.
            given_values = np.zeros(())
        elif is_of_scene(one.name):
            arrays = [scene_arrays(scene)[one.name] for scene in scenes[: size[0]]]
            given_values = np.stack([np.asarray(a, float).ravel() for a in arrays])
        elif material is not None and one.name in MATERIAL_PARAMETERS:
            given_values = np.asarray(getattr(material, one.name), float)
        if given_values.shape[-1:] == (3,) and size[1] == 1:
            # One number for three colours: their mean.
            given_values = given_values.mean(axis=-1, keepdims=True)
        values.append(np.broadcast_to(given_values, size).ravel())
    return np.concatenate(values)


def _scales(parameters: tuple[Parameter, ...], first: np.ndarray) -> np.ndarray:
    """Units in which the scene's entries are of order 1."""
    scales, ends = [], np.cumsum([one.size for one in parameters])
    for one, end in zip(parameters, ends, strict=True):
        scale = np.abs(first[end - one.size : end]).max()
        if one.form == "rotation":
            scale = np.rad2deg(1.0)
        elif not is_of_scene(one.name) or one.form == "direction" or scale == 0:
            scale = 1.0
        scales.append(np.full(one.size, scale))
    return np.concatenate(scales)


def _rotations(
    parameters: tuple[Parameter, ...], scenes: Sequence[Scene]
) -> np.ndarray:
    """First values of the unknown rotations, exactly orthonormal, (rotations, 3, 3)."""
    found = [
        nearest_rotation(np.asarray(scene_arrays(scene)[one.name]))
        for one in parameters
        if one.form == "rotation"
        for scene in scenes[: len(one.rows)]
    ]
    return np.array(found).reshape(-1, 3, 3)


def _held(
    names: _Names,
    fixed: Mapping[str, Any],
    ties: Mapping[str, Tie],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """For each entry: factor, offset, whether fixed, and the entry it is tied to."""
    size = len(names.table.label)
    factor, offset = np.ones(size), np.zeros(size)
    is_fixed, source = np.zeros(size, bool), np.arange(size)
    for name, given in fixed.items():
        entries = names.entries("fixed", name)
        if (names.table.form[entries] == "direction").any():
            raise ValueError(f"fixed: {name} is a direction; leave it out of unknowns")
        offset[entries] = names.numbers("fixed", name, given)
        factor[entries], is_fixed[entries] = 0, True
    for name, given in ties.items():
        share, other = _share_and_name(name, given)
        entries, others = names.entries("ties", name), names.entries("ties", other)
        if len(others) not in (1, len(entries)):
            raise ValueError(
                f"ties: {name} has {len(entries)} numbers, {other} has {len(others)}"
            )
        for entry, target in zip(entries, np.resize(others, len(entries)), strict=True):
            _check_tie(names, int(entry), int(target), is_fixed, source)
            factor[entry], source[entry] = share, target
    return _followed(factor, offset, is_fixed, source)


def _share_and_name(name: str, given: Tie) -> tuple[float, str]:
    try:
        share, other = given
        factor = float(share)
    except Exception:
        factor, other = np.nan, None
    if not np.isfinite(factor) or not isinstance(other, str):
        raise ValueError(
            f"ties: {name}: expected a name or (factor, name), got {shown(given)}"
        )
    return factor, other


def _check_tie(
    names: _Names, entry: int, target: int, is_fixed: np.ndarray, source: np.ndarray
) -> None:
    label, other = names.table.label[[entry, target]]
    if is_fixed[entry]:
        raise ValueError(f"ties: {label} is fixed already")
    if source[entry] != entry:
        raise ValueError(f"ties: {label} is tied twice")
    end = target
    while source[end] != end:
        end = source[end]
    if end == entry:
        raise ValueError(f"ties: {label} is tied to itself")
    forms = set(names.table.form[[entry, target]])
    if "direction" in forms:
        raise ValueError(f"ties: {label} to {other}: directions cannot be tied")
    both = names.table.parameter[[entry, target]]
    materials = {name in MATERIAL_PARAMETERS for name in both}
    if len(forms) > 1 or len(materials) > 1:
        raise ValueError(
            f"ties: {label} to {other}: reflectances, exponents and numbers of the "
            "scene can only be tied among themselves"
        )


def _followed(
    factor: np.ndarray,
    offset: np.ndarray,
    is_fixed: np.ndarray,
    source: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Resolve ties to entries that are themselves tied or fixed."""
    for entry in range(len(source)):
        while source[source[entry]] != source[entry]:
            target = source[entry]
            factor[entry] *= factor[target]
            source[entry] = source[target]
        target = source[entry]
        if target != entry and is_fixed[target]:
            offset[entry] = factor[entry] * offset[target]
            factor[entry], is_fixed[entry], source[entry] = 0, True, entry
    return factor, offset, is_fixed, source


def _boxes(
    names: _Names, bounds: Mapping[str, tuple[float, float]], is_fixed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of all entries in the user's units."""
    low, high = names.table.low.copy(), names.table.high.copy()
    for name, box in bounds.items():
        # Bounds of known parameters are ignored.
        if name in DEFAULT_BOUNDS and name not in names.table.parameter:
            continue
        entries = names.entries("bounds", name)
        if (names.table.form[entries] == "direction").any():
            raise ValueError(f"bounds: {name}: a direction has none")
        for entry in entries[is_fixed[entries]]:
            raise ValueError(f"bounds: {names.table.label[entry]} is fixed")
        low[entries], high[entries] = _box(name, box, str(names.table.form[entries[0]]))
    return low, high


def _narrowed(
    names: _Names,
    low: np.ndarray,
    high: np.ndarray,
    factor: np.ndarray,
    source: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Narrow each entry's box so that entries tied to it stay within their bounds."""
    low, high = low.copy(), high.copy()
    for entry, target in enumerate(source):
        if entry == target:
            continue
        box = np.array([low[entry], high[entry]])
        inside = box[0] <= 0 <= box[1]
        if factor[entry] != 0:
            ends = np.sort(box / factor[entry])
            low[target] = max(low[target], ends[0])
            high[target] = min(high[target], ends[1])
            inside = low[target] < high[target]
        if not inside:
            label, other = names.table.label[[entry, target]]
            raise ValueError(
                f"ties: {label} = {factor[entry]:g} × {other} leaves {other} no range "
                f"of values within the bounds of both ({label}: {box[0]:g} … "
                f"{box[1]:g})"
            )
    return low, high


def _check_fixed(
    names: _Names, value: np.ndarray, is_fixed: np.ndarray, ties: Mapping[str, Tie]
) -> None:
    """Check that entries that cannot be negative are not held below 0."""
    for entry in np.flatnonzero(is_fixed):
        if value[entry] < 0 <= names.table.low[entry]:
            label = names.table.label[entry]
            tied = any(entry in names.entries("ties", name) for name in ties)
            raise ValueError(
                f"{'ties' if tied else 'fixed'}: {label} is held at {value[entry]:g}, "
                "a number ≥ 0 is expected"
            )


def _box(name: str, box: tuple[float, float], form: str) -> tuple[float, float]:
    try:
        low, high = (float(edge) for edge in box)
    except Exception as error:
        raise ValueError(
            f"bounds: {name}: expected (low, high), got {shown(box)}"
        ) from error
    if not low < high:
        raise ValueError(f"bounds: {name}: {low:g} < {high:g} does not hold")
    if form == "logarithm" and (low <= 0 or not np.isfinite(high)):
        raise ValueError(
            f"bounds: {name}: expected 0 < low and a finite high, got ({low:g}, "
            f"{high:g})"
        )
    return low, high


def covariance_of(
    key: str | tuple[str, ...], given: Any, size: int
) -> Float[np.ndarray, "n n"]:
    """A covariance matrix, from a matrix, one standard deviation, or one for each.

    **Raises:** `ValueError` that names the entry.
    """
    name = ", ".join(as_names(key))
    wanted = f"({size}, {size}), or {size} standard deviations"
    try:
        array = np.asarray(given, float)
        if array.ndim < 2:
            array = np.diag(np.broadcast_to(array, size) ** 2)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (size, size) or not np.isfinite(array).all():
        raise ValueError(
            f"uncertain: {name}: expected a covariance {wanted}, got {shown(given)}"
        )
    return as_covariance(f"uncertain: {name}", array)


def _priors(
    names: _Names,
    asked: Specification,
    first: np.ndarray,
    scale: np.ndarray,
    is_fixed: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Priors of all entries.

    **Returns:** means; standard deviations; true where an entry has a prior; and the
    whitening matrix, a root of the joint precision of the entries with a prior.
    """
    size = len(names.table.label)
    mean, has = np.zeros(size), np.zeros(size, bool)
    covariance = np.eye(size)
    for name, given in asked.priors.items():
        try:
            center, width = given
        except Exception as error:
            raise ValueError(
                f"priors: {name}: expected (mean, standard deviation), got "
                f"{shown(given)}"
            ) from error
        entries = names.entries("priors", name)
        mean[entries] = names.numbers("priors", name, center)
        deviation = names.numbers("priors", name, width)
        if np.any(deviation <= 0):
            raise ValueError(f"priors: {name}: expected a standard deviation > 0")
        covariance[entries, entries] = deviation**2
        has[entries] = True
    unknown = set(names.table.parameter[~names.table.nuisance])
    for key, given in asked.uncertain.items():
        own = as_names(key)
        if len({name in unknown for name in own}) > 1:
            raise ValueError(
                f"uncertain: {', '.join(own)}: expected all of them to be unknown, "
                "or none, since their errors are correlated"
            )
        entries = np.concatenate([names.entries("uncertain", name) for name in own])
        if has[entries].any():
            raise ValueError(f"priors: {key}: expected it or uncertain, got both")
        block = covariance_of(key, given, len(entries))
        if not unknown.issuperset(own):
            block = _with_floor(names, entries, block, first, scale)
        elif names.table.form[entries[0]] != "direction" and _is_singular(block):
            raise ValueError(
                f"uncertain: {key}: expected a covariance of full rank, since it is "
                "unknown: an exactly known array cannot be an unknown"
            )
        mean[entries], has[entries] = first[entries], True
        covariance[np.ix_(entries, entries)] = block
    for entry in np.flatnonzero(has & is_fixed):
        raise ValueError(f"priors: {names.table.label[entry]} is fixed")
    deviation = np.sqrt(np.diag(covariance))
    return mean, deviation, has, _whitening(covariance[np.ix_(has, has)])


def _with_floor(
    names: _Names,
    entries: np.ndarray,
    block: np.ndarray,
    first: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray:
    """A covariance of nuisances with small variances in place of 0.

    So exactly known combinations hardly move. Directions vary in their tangent plane.
    """
    variance = np.maximum(FLOOR * np.diag(block), (HELD * scale[entries]) ** 2)
    across = np.eye(len(entries))
    for k, entry in enumerate(entries):
        if names.table.form[entry] == "direction" and names.table.part[entry] == 0:
            own = slice(k, k + 3)
            unit = first[entry : entry + 3] / np.linalg.norm(first[entry : entry + 3])
            across[own, own] -= np.outer(unit, unit)
            variance[own] = variance[own].max()
    return across @ (block + np.diag(variance)) @ across


def _scaled_eigen(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return values, vectors, scale


def _is_singular(covariance: np.ndarray) -> bool:
    return bool(_scaled_eigen(covariance)[0].min() <= SINGULAR)


def _whitening(covariance: np.ndarray) -> np.ndarray:
    """Whitening matrix: maps numbers of this covariance to independent unit variance.

    Combinations of variance 0 are mapped to 0, so that a direction's length does not
    count as a measurement.
    """
    values, vectors, scale = _scaled_eigen(covariance)
    known = values > SINGULAR
    root = np.where(known, 1 / np.sqrt(np.where(known, values, 1)), 0)
    return (vectors * root) @ vectors.T / scale
