"""Some of the campaign, others each day; and the judge sees what it must."""

import importlib.util
import json
import os
import subprocess
import sys

import pytest

QUICK = ("archives", "bombs", "cameras", "pictures", "records", "shapes")
FAULTS = {
    "taken": None,
    "refused": None,
    "refused by a command": None,
    "written": None,
    "no words": "no words",
    "traceback": "traceback: AttributeError in planted.py",
    "wrong": "wrong: other pixels",
    "memory": "memory: ",
    "memory of the machine": "memory: MemoryError",
    "time": "time: ",
    "noise": "noise: b'a library complains'",
    "left": "traces: left: outside/case/.out-1234",
    "changed": "traces: changed: outside/case/file.txt",
    "lost": "traces: lost: outside/case/file.txt",
    "outside": "traces: changed: outside/canary.txt",
    "killed": "the process died of SIGSEGV",
    "after a death": None,
}

linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def run(*words: str) -> subprocess.CompletedProcess[str]:
    """A module of the campaign, as from a terminal."""
    return subprocess.run(
        [sys.executable, "-m", *words],
        env=os.environ | {"JAX_ENABLE_X64": "0"},
        capture_output=True,
        text=True,
    )


@pytest.mark.extended
@linux
def test_the_judge_sees_faults():
    seen = json.loads(run("tests.campaign.planted").stdout)
    assert seen.keys() == FAULTS.keys()
    for name, (taken, fault) in seen.items():
        wanted = FAULTS[name]
        assert (fault is None) == (wanted is None), (name, fault)
        assert wanted is None or fault.startswith(wanted), (name, fault)
        if wanted is None:
            assert taken == (not name.startswith("refused"))


@linux
def test_some_cases_of_today():
    """A hundred, of the kinds for which nothing is fitted first."""
    done = run("tests.campaign", "--cases", "100", "--workers", "1", "--only", *QUICK)
    assert done.returncode == 0, done.stdout + done.stderr


@linux
@pytest.mark.extended
def test_cases_of_today():
    """Of all kinds in one run: to start it takes as long as hundreds of them."""
    done = run("tests.campaign", "--cases", "2000", "--workers", "1")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.extended
def test_what_fuzzing_wants_is_said():
    if importlib.util.find_spec("atheris") is not None:
        pytest.skip("atheris is installed here")
    done = run("tests.campaign.fuzz")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr == "atheris is not installed: pip install atheris\n"
