import numpy as np
import pytest

from experiments.shading_methods import (
    EXPERIMENT,
    EXPONENTS,
    METHODS,
    ROWS,
    crossing,
    edge_jumps,
)


@pytest.mark.extended
def test_what_gouraud_loses_it_regains_on_finer_meshes(found):
    finding = found(EXPERIMENT)
    numbers = finding.numbers
    assert not finding.failed_checks
    assert len(ROWS) == 5 and set(METHODS) == {"flat", "Gouraud", "Phong"}
    kept = numbers["peak"]["Gouraud"].mean(axis=-1)
    assert np.all(numbers["peak"]["Phong"] == 1)
    assert np.all(np.diff(kept, axis=0) > -0.02) and np.all(kept[-1] > 0.97)
    # The narrower the highlight, the more is lost on the coarsest mesh.
    assert np.all(np.diff(kept[0]) < 0) and kept[0, -1] < 0.3
    # Never more than Phong shading's, whose normals are the same at the vertices.
    assert np.all(numbers["peak"]["Gouraud"] < 1.02)
    off = np.abs(numbers["energy"]["Gouraud"] - 1).mean(axis=-1)
    assert np.all(off[-1] < 0.005) and np.all(off[0] > off[-1])


@pytest.mark.extended
def test_when_gouraud_is_good_enough(found):
    finding = found(EXPERIMENT)
    enough = finding.numbers["fine_enough"]
    # One rule for all exponents: an edge of some half of the highlight's half width.
    assert len(enough) == len(EXPONENTS) and np.all((0.3 < enough) & (enough < 1))
    assert np.ptp(enough) < 0.5 * enough.mean()
    assert f"shorter than {enough.mean():.2f} of the highlight's half" in finding.answer


@pytest.mark.extended
def test_mach_bands(found):
    numbers = found(EXPERIMENT).numbers
    gouraud, phong = (numbers["slope_jump"][name] for name in ("Gouraud", "Phong"))
    assert np.all(gouraud[:3] > 2 * phong[:3])
    # The jump goes with the length of the edges.
    slope = np.polyfit(np.log(numbers["edge"]), np.log(gouraud), 1)[0]
    assert slope == pytest.approx(1, abs=0.2)
    # Flat shading jumps in the light itself, and is level on each face.
    values = numbers["value_jump"]
    assert np.all(values["flat"] > 5 * values["Gouraud"])
    assert np.all(numbers["slope_jump"]["flat"] < 1e-3)


@pytest.mark.extended
def test_the_cost_of_each_is_measured(found):
    numbers = found(EXPERIMENT).numbers
    for seconds in numbers["seconds"].values():
        assert seconds.shape == (2,) and np.all(seconds > 0)
    ratio = numbers["seconds"]["Gouraud"] / numbers["seconds"]["Phong"]
    words = f"{ratio[0]:.2f} (Gouraud)"
    assert words in found(EXPERIMENT).answer


@pytest.mark.extended
def test_jumps_of_a_mesh():
    """A coarse ball: slopes within a face of Gouraud shading are those of a plane."""
    jumps = edge_jumps(6, 64)
    assert jumps["flat"][0] < 1e-9 and jumps["flat"][1] > 0.05
    assert jumps["Gouraud"][0] > jumps["Phong"][0] > 0


@pytest.mark.parametrize(
    "y, expected",
    [
        ([0.01, 0.1, 1.0], 10**0.5),
        ([0.1, 0.2, 0.3], np.nan),
        ([0.01, 0.02, 0.03], np.nan),
    ],
)
def test_crossings(y, expected):
    found = crossing(np.array([1.0, 10.0, 100.0]), np.array(y), 10**-1.5)
    assert found == pytest.approx(expected, nan_ok=True)
