from experiments import textured_object


def test_texels_are_within_their_errors(monkeypatch, capsys):
    monkeypatch.setattr(textured_object, "SMALL", textured_object.Size(32, 56, 32, 16))
    assert textured_object.main(textured_object.Options()) == 0
    assert "seen three times: pulls have an RMS of" in capsys.readouterr().out
