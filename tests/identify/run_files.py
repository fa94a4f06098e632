"""Files of a run, as the stages write them."""

from identify.files.atomic import write_bytes, write_text
from identify.files.dataset import covariance_netcdf, parameter_units, write_groups
from identify.record.model_runs import model_groups
from identify.record.recording import run_groups
from identify.trajectory import trajectories_json


def write_covariance(path, layout, covariance, others=()):
    write_bytes(path, covariance_netcdf(parameter_units(layout, others), covariance))


def write_model_runs(path, excitation, validation=()):
    write_groups(path, model_groups(excitation, validation))


def write_runs(path, runs):
    write_groups(path, run_groups(runs))


def save_trajectories(path, trajectories):
    write_text(path, trajectories_json(trajectories))
