"""The commands that the baselines add to `manifeel`, through the entry point group `manifeel.commands`."""

from manifeel_ms3.plugins import Command

TRAIN = Command("baselines.train", "Train a policy.")
STUDY = Command("baselines.studies.__main__", "Record, train and evaluate everything that a study combines.")
