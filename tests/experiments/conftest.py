"""Experiments at their small size, each made once for all tests."""

import functools

import pytest

from experiments.finding import Experiment, Finding


@functools.cache
def _found(experiment: Experiment) -> Finding:
    return experiment.find(True)


@pytest.fixture(scope="session")
def found():
    """What an experiment finds at its small size."""
    return _found
