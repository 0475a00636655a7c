"""Records read off classes: what stands in a file is what a constructor takes."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float, Int

from phongfit.checks import as_light, as_scalar, at_least
from phongfit.files.arguments import Arguments, arguments_of, describe
from phongfit.files.records import parse_record, read_record
from phongfit.vectors import Rgb, Scalar
from tests.helpers import floats, said


class Bulb(eqx.Module):
    """A part of a thing."""

    power: Scalar

    def __init__(self, power=2.0):
        self.power = as_scalar("power", power)


class Thing(eqx.Module):
    """One of every kind of field."""

    size: Scalar
    colour: Rgb
    axes: Float[Array, "3 3"]
    tint: Rgb | None
    bulbs: tuple[Bulb, ...]
    table: Float[Array, "rows 2"] | None
    index: Int[Array, " n"]
    name: str = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        index,
        size=1.0,
        colour: Any = 0.5,
        axes=None,
        tint=None,
        *,
        bulbs=(),
        table=None,
        name="none",
        extra=None,
    ):
        del extra
        self.index = jnp.asarray(index)
        self.size = at_least("size", as_scalar("size", size), 0)
        self.colour = as_light("colour", colour)
        self.axes = floats(np.eye(3) if axes is None else axes)
        self.tint = None if tint is None else as_light("tint", tint)
        self.bulbs = tuple(bulbs)
        self.table = None if table is None else floats(table)
        self.name = name
        self.shape = self.index.shape


@arguments_of(Thing, {"size": "size_metres"})
class ThingRecord(Arguments):
    """A thing."""


def test_round_trip(tmp_path):
    table = floats(np.arange(6.0).reshape(3, 2))
    thing = Thing([3, 1], 2.5, (0.1, 0.2, 0.3), bulbs=[Bulb(), Bulb(7)], table=table)
    beside = {}
    data = describe(thing, "thing", beside)
    wanted = ["size_metres", "colour", "axes", "bulbs", "table", "index", "name"]
    assert list(data) == wanted
    assert data["bulbs"] == [{"power": 2.0}, {"power": 7.0}]
    assert data["table"] == "thing_table.npy" and set(beside) == {
        "thing_table.npy",
        "thing_index.npy",
    }
    for name, array in beside.items():
        np.save(tmp_path / name, array)
    (tmp_path / "t.json").write_text(str(data).replace("'", '"'))
    back = read_record(tmp_path / "t.json", ThingRecord).build()
    assert eqx.tree_equal(back, thing)


def test_what_is_left_out_is_the_constructors(tmp_path):
    np.save(tmp_path / "i.npy", [1])
    thing = parse_record('{"index": "i.npy"}', ThingRecord, tmp_path).build()
    assert eqx.tree_equal(thing, Thing([1]))


@pytest.mark.parametrize(
    "text, message",
    [
        ("{}", "index: is missing"),
        (
            '{"size_metre": 1}',
            "did you mean 'size_metres'?",
        ),
        ('{"size_metres": [1]}', "size_metres: expected a valid number, got [1]"),
        ('{"axes": [1, 0, 0]}', "axes[0]: expected three numbers, got 1"),
        ('{"colour": [1, 0]}', "colour: expected one number or three, got [1, 0]"),
        (
            '{"bulbs": [{}, {"power": "x"}]}',
            'bulbs[1].power: expected a valid number ... got "x"',
        ),
        (
            '{"index": "../i.npy"}',
            "index: expected the name of a file in this ... got '../i.npy'",
        ),
    ],
)
def test_one_line_of_what_is_wrong(tmp_path, text, message):
    with pytest.raises(ValueError) as caught:
        parse_record(text, ThingRecord, tmp_path)
    assert said(message, str(caught.value)) and "\n" not in str(caught.value)


def test_the_constructor_speaks_in_the_files_names(tmp_path):
    np.save(tmp_path / "i.npy", [1])
    text = '{"index": "i.npy", "size_metres": -1}'
    with pytest.raises(ValueError, match="^size_metres: expected .*, got -1."):
        parse_record(text, ThingRecord, tmp_path).build()


def test_arrays_need_a_folder():
    with pytest.raises(ValueError, match="only a scene file can have an array"):
        describe(Thing([1]))
    with pytest.raises(ValueError, match="expected a text in a folder"):
        parse_record('{"index": "i.npy"}', ThingRecord)


def test_classes_that_files_cannot_hold():
    class Lost(eqx.Module):
        def __init__(self, power):
            del power

    class Function(eqx.Module):
        function: Callable[[float], float]

    class Kind(eqx.Module):
        kind: str

    for made, keys, message in (
        (Lost, {}, "power: Lost keeps it in no field"),
        (Function, {}, "Function.function: files have no place for"),
        (Kind, {}, "kind: files have another use for this name"),
        (Bulb, {"watts": "power"}, "watts: Bulb takes no such argument"),
    ):
        with pytest.raises(ValueError, match=message):
            arguments_of(made, keys, kind="it")
    with pytest.raises(ValueError, match="Lost: cannot be saved .* phongfit.register"):
        describe(Lost(1))
