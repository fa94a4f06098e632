"""Stage that names causes of the misfit between the identified model and its record."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dynamics import load_robot
from identify.diagnosis.cause import Cause
from identify.diagnosis.diagnose import diagnosis_from
from identify.diagnosis.diagnosis import Diagnosis
from identify.estimation.identification import output_error_problem
from identify.files.run_folder import RunFolder, check_entries, load_result, save_result
from identify.loop_parameters import settled_drive
from identify.model.model_side import model_side
from identify.record.known_geometry import known_geometry
from identify.record.provenance import RECORDS, RunFiles
from identify.reporting.run_result import parameter_vector
from identify.scenario import load_scenario
from identify.stages.plan import identified_files

ENTRY = "diagnosis"  # name of the entry of result.json that holds the diagnosis


def diagnose(folder: Path, own: Sequence[Cause] = ()) -> Diagnosis:
    """Diagnose the identified model of a run folder, and store the diagnosis in result.json.

    own: the user's own causes, which are tried as well. Raises RecordError if the result is
    incomplete or was made of another record, and the errors of `identify.diagnose`.
    """
    run_folder = RunFolder(folder)
    run_folder.require("scenario.toml", "experiment.nc", "result.json")
    files = RunFiles(run_folder)
    result = load_result(run_folder.result)
    check_entries(run_folder.result, result, "identify")
    files.check_made_of(*RECORDS, result=result)
    scenario = load_scenario(run_folder.whole_scenario)
    robot = known_geometry(load_robot(scenario.robot), scenario.geometry, folder).robot
    identification = result["identification"]
    side = model_side(robot, scenario).with_drive(settled_drive(identification))
    records = [
        files.content(name) for name in identified_files(run_folder, scenario.identification)
    ]
    problem = output_error_problem(records, side, scenario.identification)
    estimate = parameter_vector(side.robot, identification, "estimate")
    found = diagnosis_from(problem, estimate, own, identification["nuisance_estimates"])
    save_result(run_folder.result, with_diagnosis(result, found))
    return found


def with_diagnosis(result: dict[str, Any], found: Diagnosis) -> dict[str, Any]:
    """Return a result with a diagnosis, whose warnings replace those of an earlier diagnosis."""
    identification = result["identification"]
    earlier = (result.get(ENTRY) or {}).get("warnings", [])
    kept = [text for text in identification["warnings"] if text not in earlier]
    warned = identification | {"warnings": [*kept, *found.warnings()]}
    return result | {"identification": warned, ENTRY: found.to_dict()}
