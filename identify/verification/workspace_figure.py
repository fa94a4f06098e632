"""Figures of workspace maps: colour is travel used or conditioning, lines are the travel limit and the reach."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from identify.files.figure import blank_figure
from identify.verification.workspace_map import WorkspaceMap, WorkspacePlane

NAMES = ("x", "y", "z", "α", "β", "γ")
COLUMNS = 3


def travel_figure(workspace: WorkspaceMap) -> Figure:
    """Largest crank angle as a share of the travel limit."""
    title = f"{workspace.robot}: travel used, largest |θ| / {workspace.home.travel_limit:.4f} rad"
    return _maps(workspace, "travel_share", title, "largest |θ| / travel limit", Normalize(0, 1.5))


def conditioning_figure(workspace: WorkspaceMap) -> Figure:
    """Condition number of the joint Jacobian with rotations scaled by the characteristic length."""
    length = f"rotations × {workspace.characteristic_length_m:.3g} m"
    title = f"{workspace.robot}: condition of the joint Jacobian J_ad ({length})"
    return _maps(workspace, "condition", title, "condition of J_ad", LogNorm(1, 30))


def _maps(workspace: WorkspaceMap, quantity: str, title: str, label: str, norm: Normalize) -> Figure:
    figure = blank_figure(12, 8)
    panels = figure.subplots(-(-len(workspace.planes) // COLUMNS), COLUMNS, squeeze=False)
    for axes, plane in zip(panels.flat, workspace.planes, strict=False):
        shown = _panel(axes, plane, getattr(plane, quantity), norm)
    figure.colorbar(shown, ax=panels, label=label, extend="max")
    figure.suptitle(f"{title}\nsolid: travel limit, dashed: reach of a leg (blank beyond)")
    return figure


def _panel(axes: Axes, plane: WorkspacePlane, values: np.ndarray, norm: Normalize) -> QuadMesh:
    across, up = 1e3 * plane.horizontal, 1e3 * plane.vertical
    shown = axes.pcolormesh(across, up, values, norm=norm, cmap="viridis", shading="nearest", rasterized=True)
    for field, level, style, colour in ((plane.travel_share, 1.0, "-", "white"), (plane.reach_margin, 0.0, "--", "k")):
        finite = field[np.isfinite(field)]
        if finite.size and finite.min() < level < finite.max():
            axes.contour(across, up, field, [level], linestyles=style, colors=colour, linewidths=1.5)
    axes.set_xlabel(f"{NAMES[plane.across]} [{_unit(plane.across)}]")
    axes.set_ylabel(f"{NAMES[plane.up]} [{_unit(plane.up)}]")
    axes.set_title(f"{NAMES[plane.fixed]} = {1e3 * plane.value:.4g} {_unit(plane.fixed)}")
    axes.set_aspect("equal")
    return shown


def _unit(component: int) -> str:
    return "mm" if component < 3 else "mrad"
