import dataclasses
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import phongfit as pf
from phongfit.files.outputs import write_json
from phongfit.fitting.problem.specification import Specification
from phongfit.fitting.result import fit_table
from phongfit.fitting.solve.search import SearchResult
from phongfit.fitting.uncertainty.intervals import Quadratic
from phongfit.fitting.uncertainty.misfit import Misfit
from phongfit.fitting.uncertainty.region import Part, Region
from phongfit.material import Material

LABELS = ("diffuse.red", "diffuse.green", "specular", "shininess")
COVARIANCE = np.array(
    [
        [0.0001, -0.00005, 0, np.nan],
        [-0.00005, 0.0001, 0.00009, np.nan],
        [0, 0.00009, 0.0004, np.nan],
        [np.nan, np.nan, np.nan, np.inf],
    ]
)


# Specular lies near its bound, and may go further up than down.
STEPS = np.diag([1e4, 1e4, 2500.0, 1e-30])
LOWER, UPPER = np.array([-9, -9, -0.005, -9.0]), np.full(4, 9.0)
ABOUT = Quadratic(STEPS, np.zeros(4), LOWER, UPPER, 0.0, np.zeros(4))
REGION = Region(
    np.array([0.5, 0.25, 0.125, 40.0]),
    np.eye(4),
    np.zeros(4, bool),
    np.array([[0, 1], [0, 1], [0, 1], [1, 1000.0]]),
    np.array([False, False, False, True]),
    lambda: (Part(np.arange(4), (ABOUT,)),),
)


def result(**changes) -> pf.Fit:
    """A result written by hand, so that its table can be read off."""
    return dataclasses.replace(
        pf.Fit(
            specification=Specification(),
            films=(pf.Film(encoding="srgb", bits=8),),
            material=Material((0.5, 0.25, 0.0), 0.125, 40.0),
            stderr=Material((0.01, 0.01, 0.0), 0.02, 0.0),
            scene=pf.Scene(pf.Sphere()),
            exposure=np.ones(1),
            labels=LABELS,
            values=np.array([0.5, 0.25, 0.125, 40.0]),
            errors=np.array([0.01, 0.01, 0.02, np.inf]),
            covariance=COVARIANCE,
            at_bound=np.zeros(4, bool),
            unidentified=np.array([False, False, False, True]),
            bounds=np.array([[0, 1], [0, 1], [0, 1], [1, 1000.0]]),
            tied=np.zeros(4, bool),
            photographs=np.zeros((2, 2, 3)),
            fitted=np.zeros((2, 2, 3)),
            residuals=np.zeros((2, 2, 3)),
            noise=0.0123,
            noise_given=False,
            arrays=(),
            n_samples=12345,
            n_images=1,
            degrees_of_freedom=12342,
            chi_squared=12342.0,
            misfit=Misfit(),
            model="BlinnPhong",
            converged=True,
            steps=7,
            reason="it was good",
            warnings=("shininess is not identifiable: " + 20 * "because it is so, ",),
            region=REGION,
            # Nothing here asks for it.
            solution=object.__new__(SearchResult),
        ),
        **changes,
    )


def rows(text: str) -> dict[str, list[str]]:
    """The words of each line of the table of parameters, by its first."""
    lines = [line.split() for line in text.splitlines() if "±" in line]
    return {first: rest for first, *rest in lines}


def test_values_and_errors():
    table = rows(str(result()))
    assert table["diffuse.red"] == ["0.500", "±", "0.01", "2"]
    assert table["specular"] == ["0.125", "±", "0.02", "16", "+0.02", "−0.005"]
    assert table["shininess"] == ["40", "±", "∞", "not", "identifiable"]


def test_head():
    text = str(result())
    for words in (
        "1 image, 12,345 samples, BlinnPhong, clamped, 8-bit srgb",
        "converged after 7 steps: it was good",
        "noise 0.0123 (estimated)",
        "noise 0.0123 (estimated)\n",
        "loss Linear",
        "std. error",
    ):
        assert words in text
    several = str(result(n_images=3, noise_given=True, converged=False))
    for words in ("3 images", "(given), reduced χ² 1", "NOT CONVERGED after 7"):
        assert words in several


def test_at_a_bound():
    at_bound = np.array([True, False, False, False])
    values = np.array([0.0, 0.25, 0.125, 40.0])
    table = str(result(at_bound=at_bound, values=values))
    marked = [line for line in table.splitlines() if "at its bound" in line]
    assert len(marked) == 1 and "diffuse.red" in marked[0]
    # Nothing is a share of zero.
    assert "–" in marked[0] and "inf" not in marked[0]


def test_correlations_by_size():
    lines = str(result()).splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("correlations"))
    found = [line.split() for line in lines[start + 1 : start + 4]]
    # -0.00005 / 0.0001, and 0.00009 / (0.01 · 0.02).
    assert found[0] == ["diffuse.green", "diffuse.red", "-0.500"]
    assert found[1] == ["specular", "diffuse.green", "+0.450"]
    assert len(found[2]) == 0
    assert "correlations" not in fit_table(result(), least_correlation=0.6)
    few = fit_table(result(), most=1)
    assert "-0.500" in few and "+0.450" not in few


def test_warnings_and_width():
    text = str(result())
    assert text.count("  ! ") == 1
    # Wrapped, not cut.
    assert " ".join(text.split()).count("because it is so,") == 20
    assert max(len(line) for line in text.splitlines()) <= 90
    assert "warnings" not in str(result(warnings=()))


def test_extreme_numbers_stay_in_their_columns():
    values = np.array([1e-7, 0.99999999, 0.5, 999.99])
    errors = np.array([3e-9, 1e-12, 0.0, 123.0])
    unidentified = np.zeros(4, bool)
    text = str(result(values=values, errors=errors, unidentified=unidentified))
    assert "nan" not in text.lower()
    assert max(len(line) for line in text.splitlines()) <= 90
    lines = [line for line in text.splitlines() if "±" in line]
    assert len({line.index("±") for line in lines}) == 1


def test_print_shows_the_table_and_repr_one_line():
    assert str(result()) == fit_table(result())
    assert repr(result()) == "<Fit of 1 image: 4 parameters, 1 warning, converged>"


def test_numbers_of_a_result():
    fit = result()
    assert fit.degrees_of_freedom == 12345 - 3
    assert np.isnan(fit.reduced_chi_squared)
    assert result(noise_given=True).reduced_chi_squared == pytest.approx(1.0)
    correlation = fit.correlation
    assert np.allclose(np.diag(correlation)[:3], 1)
    assert np.all(np.isnan(correlation[3]))
    assert correlation[1, 0] == pytest.approx(-0.5)


def test_json(tmp_path):
    path = tmp_path / "fit.json"
    fit = result()
    write_json(path, fit.to_dict())
    read = json.loads(path.read_text())
    assert json.loads(json.dumps(fit.to_dict(), allow_nan=False)) == read
    assert read["degrees_of_freedom"] == 12342 and read["bounds"][3] == [1, 1000]
    assert read["values"] == [0.5, 0.25, 0.125, 40.0]
    assert read["errors"] == [0.01, 0.01, 0.02, None]
    assert read["labels"] == list(LABELS)
    assert [row["label"] for row in read["parameters"]] == list(LABELS)
    low, high = read["intervals"][0]
    assert read["parameters"][0] == {
        **{"label": LABELS[0], "value": 0.5, "error": 0.01, "low": low, "high": high},
        **{"at_bound": False, "unidentified": False, "tied": False},
    }
    assert read["parameters"][3]["error"] is None

    assert read["material"]["diffuse"] == [0.5, 0.25, 0.0]
    assert read["unidentified"] == [False, False, False, True]
    assert read["warnings"] == list(fit.warnings)
    assert read["converged"] is True and read["steps"] == 7
    assert read["covariance"][0][:3] == [0.0001, -0.00005, 0]
    assert not {"photographs", "fitted", "residuals"} & set(read)


def test_a_data_frame(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="to_dataframe: .*pip install pandas"):
        result().to_dataframe()

    class DataFrame(list):
        def set_index(self, name):
            return {row.pop(name): row for row in self}

    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=DataFrame))
    rows = result().to_dataframe()
    assert list(rows) == list(LABELS) and rows[LABELS[1]]["value"] == 0.25
    assert rows[LABELS[3]]["error"] == np.inf
