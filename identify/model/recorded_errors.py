"""Common errors of a record that a model can have, from the record and the model's side."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

import xarray as xr

from identify.arrays import Array
from identify.model.body_errors import body_error_stds
from identify.model.loop_errors import loop_error_stds
from identify.model.loop_model import LoopModel
from identify.model.model_side import ModelSide
from identify.record.conditions import takes_torques
from identify.record.geometry_errors import GeometryErrors, read_geometry_covariance
from identify.record.stored_common_errors import LATENCY, read_common_errors

Run = TypeVar("Run", bound=LoopModel)


def with_recorded_errors(
    run: Run,
    record: xr.Dataset,
    side: ModelSide,
    motion: Array,
    own: Mapping[str, float] = MappingProxyType({}),
) -> Run:
    """Return a model with the common errors that are estimated beside the parameters.

    Parameters
    ----------
    run : LoopModel
        Model without common errors, which need its whitener.
    record : xarray.Dataset
        Record of the run, with the errors of its poses and of the geometry.
    side : ModelSide
        Kinds of errors, and the standard deviations of those of loop and bodies.
    motion : ndarray, shape (N, 6)
        Poses of the run, which show the errors of the geometry.
    own : mapping of str to float
        Standard deviations of further errors in the loop, by name.

    Raises
    ------
    RecordError
        The record states errors that are not valid.
    """
    kinds = side.nuisances
    geometry = None
    covariance = read_geometry_covariance(record, run.robot) if "geometry" in kinds else None
    if covariance is not None:
        geometry = GeometryErrors(run.robot, covariance, motion, run.whitener)
    stds = loop_error_stds(run.robot, side.model, side.timing.latency_std_s, kinds)
    if takes_torques(record):
        # no zero and no scale of joint commands acts under torques
        stds = {name: std for name, std in stds.items() if name == LATENCY}
    common = replace(
        read_common_errors(record, kinds),
        loop_std=stds | dict(own),
        geometry=geometry,
        body_std=body_error_stds(run.robot, side.model, kinds),
        whitener=run.whitener,
    )
    return replace(run, common=common)
