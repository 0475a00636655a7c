import pytest

from experiments import textured_object
from experiments.textured_object import Options, main


@pytest.mark.extended
@pytest.mark.parametrize("disk", [False, True])
def test_texels_are_within_their_errors(disk, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(textured_object, "SMALL", textured_object.Size(32, 56, 32, 16))
    assert main(Options(disk=tmp_path / "vase" if disk else None)) == 0
    assert "seen three times: pulls have an RMS of" in capsys.readouterr().out
