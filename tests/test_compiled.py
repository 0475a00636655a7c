"""What a run of the tests leaves of compiled programs, and what it removes."""

from pathlib import Path

from tests import __main__ as runner


def test_programs_of_another_jax_go_and_ours_stay(tmp_path):
    other = tmp_path / "jax-0.1-jaxlib-0.1"
    other.mkdir()
    (other / "jit_run").write_bytes(b"old")
    (tmp_path / "thesis.txt").write_text("years of work")
    ours = runner.compiled(tmp_path)
    (ours / "jit_run").write_bytes(b"new")
    assert runner.compiled(tmp_path) == ours and (ours / "jit_run").exists()
    assert ours.stat().st_mode & 0o077 == 0
    assert {path.name for path in tmp_path.iterdir()} == {ours.name, "thesis.txt"}


def test_too_many_go(tmp_path, monkeypatch):
    ours = runner.compiled(tmp_path)
    (ours / "jit_run").write_bytes(bytes(11))
    monkeypatch.setattr(runner, "MOST", 10)
    assert runner.compiled(tmp_path) == ours and not list(ours.iterdir())


def test_precisions_write_apart_and_parts_of_one_together(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))

    def folder(name):
        return runner.precision(name)["JAX_COMPILATION_CACHE_DIR"]

    single, double = folder("float32"), folder("float64")
    assert single != double and single.startswith(str(tmp_path))
    # What the first part has compiled by then is not too much for the second.
    Path(single, "jit_run").write_bytes(bytes(11))
    monkeypatch.setattr(runner, "MOST", 10)
    assert folder("float32, second part") == single
    assert Path(single, "jit_run").exists()
