"""Data sets with known truth: synthetic photographs to fit."""

from data_synth.dataset import make_dataset as make_dataset
from data_synth.lights import make_lights as make_lights
from data_synth.writing import write_dataset as write_dataset
