"""`phongfit view`: one page, and nothing beside it."""

from phongfit.cli import main
from tests.maps.hills import write_hills


def test_a_page(tmp_path, capsys):
    folder, page = tmp_path / "maps", tmp_path / "out" / "hills.html"
    folder.mkdir()
    page.parent.mkdir()
    write_hills(folder)
    assert main(["view", str(folder), "-o", str(page), "--title", "a <b> & c"]) == 0
    assert "hills.html: 0.0 MB" in capsys.readouterr().out
    text = page.read_text()
    assert "<h1>a &lt;b&gt; &amp; c</h1>" in text
    assert "http://" not in text and "https://" not in text
    assert list(page.parent.iterdir()) == [page]


def test_no_maps(tmp_path, refused):
    assert "maps.npz" in refused("view", tmp_path, "-o", tmp_path / "a.html")
    assert not (tmp_path / "a.html").exists()
