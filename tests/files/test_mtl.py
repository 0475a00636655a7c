import numpy as np
import pytest

import phongfit as pf
from phongfit.material import unstack_materials
from tests.helpers import near

FULL = """# two materials
newmtl red clay
Ka 0.1 0.2 0.3
Kd 0.4 0.5 0.6
Ks 0.7 0.8 0.9
Ke 1.5 0 0
Ns 250   # of 0 to 1000
Ni 1.45
d 1.0
illum 2

newmtl plain
Kd 0.25
"""


def read(tmp_path, text):
    path = tmp_path / "some.mtl"
    path.write_text(text)
    return pf.read_mtl(path)


def test_what_is_read(tmp_path):
    materials = read(tmp_path, FULL)
    assert list(materials) == ["red clay", "plain"]
    clay, plain = materials.values()
    near(clay.ambient, (0.1, 0.2, 0.3))
    near(clay.diffuse, (0.4, 0.5, 0.6))
    near(clay.specular, (0.7, 0.8, 0.9))
    near(clay.emission, (1.5, 0, 0))
    near(clay.shininess, 250)
    near(plain.diffuse, 0.25)
    default = pf.Material()
    for leaf in ("ambient", "specular", "emission", "shininess"):
        near(getattr(plain, leaf), getattr(default, leaf))


def test_illumination_models(tmp_path):
    lines = "Ka 0.1 0.1 0.1\nKd 0.5 0.6 0.7\nKs 1 1 1\n"
    constant, matte, shiny = (
        read(tmp_path, f"newmtl a\n{lines}illum {number}\n")["a"]
        for number in (0, 1, 2)
    )
    near(constant.emission, (0.5, 0.6, 0.7))
    near(constant.diffuse, 0)
    near(constant.specular, 0)
    near(matte.specular, 0)
    near(matte.diffuse, (0.5, 0.6, 0.7))
    near(shiny.specular, (1, 1, 1))


@pytest.mark.parametrize("there", [True, False])
def test_textures_are_passed_over_with_a_word(tmp_path, there):
    if there:
        (tmp_path / "wood.png").write_bytes(b"")
    word = "is not read" if there else "is missing"
    with pytest.warns(
        UserWarning, match=rf"line 3: texture 'wood.png' of .*'a' {word}"
    ):
        materials = read(
            tmp_path, "newmtl a\nKd 0.5 0.5 0.5\nmap_Kd -s 2 2 1 wood.png\n"
        )
    near(materials["a"].diffuse, 0.5)


@pytest.mark.parametrize(
    "text, said",
    [
        ("Kd 1 1 1\n", "line 1: Kd: came before"),
        ("newmtl\n", "line 1: newmtl: expected a name"),
        ("newmtl a\nKd 1 1\n", "line 2: Kd: expected 1 or 3 numbers.*got '1 1'"),
        ("newmtl a\nKd spectral file.rfl 1\n", "line 2: Kd: "),
        ("newmtl a\nNs -1\n", "line 2: Ns: expected 1 number.*got '-1'"),
        ("newmtl a\nNs nan\n", "line 2: Ns: "),
        ("newmtl a\nNs\n", "line 2: Ns: "),
    ],
)
def test_broken_files(tmp_path, text, said):
    with pytest.raises(ValueError, match=f"some.mtl: {said}"):
        read(tmp_path, text)


def test_a_missing_file(tmp_path):
    with pytest.raises(ValueError, match="none.mtl: cannot be read"):
        pf.read_mtl(tmp_path / "none.mtl")


def test_what_is_written_is_read_again(tmp_path):
    rng = np.random.default_rng(0)
    several = pf.Material(
        rng.uniform(0, 1, (3, 3)),
        rng.uniform(0, 1, (3, 1)),
        rng.uniform(1, 1000, (3, 1)),
        rng.uniform(0, 1, (3, 3)),
        rng.uniform(0, 2, (3, 3)),
    )
    names = ["a", "b #2", "ü"]
    materials = dict(zip(names, unstack_materials(several), strict=True))
    pf.write_mtl(tmp_path / "out.mtl", materials)
    found = pf.read_mtl(tmp_path / "out.mtl")
    assert list(found) == names
    for name in names:
        for leaf in ("ambient", "diffuse", "specular", "emission", "shininess"):
            one = np.broadcast_to(getattr(materials[name], leaf), (3,))
            near(np.broadcast_to(getattr(found[name], leaf), (3,)), one, 1e-7)


@pytest.mark.parametrize(
    "material, said, leaf, taken",
    [
        (
            pf.Material(shininess=1500),
            "shininess: .mtl holds at most 1000, got 1500",
            "shininess",
            1000,
        ),
        (
            pf.Material(shininess=(10, 10, 80)),
            "shininess: .mtl holds one .*got 10, 10, 80",
            "shininess",
            20,
        ),
        (
            pf.Material(diffuse=(0.5, 1.25, 0)),
            "diffuse: .mtl holds at most 1, got 1.25",
            "diffuse",
            (0.5, 1, 0),
        ),
    ],
)
def test_out_of_range(tmp_path, material, said, leaf, taken):
    path = tmp_path / "out.mtl"
    with pytest.raises(ValueError, match=f"^a: {said}"):
        pf.write_mtl(path, {"a": material})
    assert not path.exists()
    with pytest.warns(UserWarning, match=said):
        pf.write_mtl(path, {"a": material}, nearest=True)
    near(getattr(pf.read_mtl(path)["a"], leaf), taken, 1e-6)


@pytest.mark.parametrize("name", ["", "a\nb", " a"])
def test_bad_names(tmp_path, name):
    with pytest.raises(ValueError, match="^materials: "):
        pf.write_mtl(tmp_path / "out.mtl", {name: pf.Material()})


def test_maps_have_no_place(tmp_path):
    with pytest.raises(
        ValueError, match="^a: diffuse: expected one material, got shape"
    ):
        pf.write_mtl(tmp_path / "out.mtl", {"a": pf.Material(np.zeros((4, 5, 3)))})


def test_every_key_that_has_no_place_is_named_once(tmp_path):
    path = tmp_path / "a.mtl"
    usual = "Ni 1.45\nd 1.0\nTr 0\nTf 1 1 1\nillum 2\n"
    path.write_text(f"newmtl a\nKd 1 1 1\n{usual}")
    assert list(pf.read_mtl(path)) == ["a"]
    path.write_text("newmtl a\nd 0.5\nPm 1\nshine 3\nnewmtl b\nd 0.1\nillum 5\n")
    with pytest.warns(UserWarning) as said:
        pf.read_mtl(path)
    words = [str(one.message).partition(".mtl: ")[2] for one in said]
    assert [one.partition(". ")[0] for one in words] == [
        "line 7: illum 5, of mirrors and glass, is taken as 2",
        "not used: d (line 2), Pm (line 3), shine (line 4)",
    ]


def test_text_as_other_programs_write_it(tmp_path):
    path = tmp_path / "some.mtl"
    text = "newmtl\tGrau-Grün #1\r\n\tKd  0.25 0.5 0.75 # grey\r\n# the end"
    for data in (b"\xef\xbb\xbf" + text.encode(), text.encode("latin-1")):
        path.write_bytes(data)
        ((name, material),) = pf.read_mtl(path).items()
        assert name == "Grau-Grün #1"
        near(material.diffuse, (0.25, 0.5, 0.75))


@pytest.mark.parametrize(
    "text, words",
    [
        ("Kd 255 128 0\n", "line 2: Kd 255 128 0 is taken as it is; expected 0 to 1"),
        ("Ks 2\n", "line 2: Ks 2 is taken as it is; expected 0 to 1"),
        ("Kd 1\nnewmtl a\n", "line 3: material 'a' goes on"),
    ],
)
def test_doubtful_numbers(tmp_path, text, words):
    with pytest.warns(UserWarning, match=words):
        read(tmp_path, f"newmtl a\n{text}")


@pytest.mark.parametrize("number", ["1.#QNAN0", "1.#INF00", "-nan(ind)", "# 3"])
def test_numbers_that_are_none(tmp_path, number):
    with pytest.raises(ValueError, match="line 2: Ns: expected 1 number ≥ 0"):
        read(tmp_path, f"newmtl a\nNs {number}\n")
