"""Another estimator on a record that exists: what may change, what may not, and who hears of it."""

import numpy as np
import pytest

from identify import pipeline
from identify.errors import ScenarioError
from identify.estimation.identification import identify
from identify.files.run_folder import load_result
from identify.progress import SilentProgress
from identify.record.recording import read
from identify.reporting.report import provenance_section, read_report_data
from identify.reporting.run_result import parameter_vector
from identify.reporting.tables import changed_settings_table
from identify.scenario import Scenario, load_scenario
from identify.scenario.scenario import SECTIONS, estimator_settings, with_estimator_settings
from tests.identify.commands import command, one_line
from tests.identify.synthetic import SHORT, rss6

DRIVEN = {"identification.method": "command_driven"}


def test_a_setting_acts_and_is_kept_for_the_next_stages_and_the_reader(recorded_folder):
    pipeline.identify(recorded_folder.path, SilentProgress(), DRIVEN)
    kept, result = load_scenario(recorded_folder.scenario), load_result(recorded_folder.result)
    assert kept == SHORT.with_overrides(DRIVEN)
    assert result["settings"]["identification.method"] == "command_driven"
    expected = identify(read(recorded_folder.experiment), rss6(), SHORT.with_overrides(DRIVEN))
    np.testing.assert_array_equal(parameter_vector(result["identification"], "estimate"), expected.estimate)
    assert result["identification"]["searches"] == ["command_driven"]
    table = changed_settings_table(result, read(recorded_folder.experiment).attrs["scenario"])
    assert table.rows == (("identification.method", "command_driven", "closed_loop"),)
    pipeline.identify(recorded_folder.path, SilentProgress())
    assert load_result(recorded_folder.result)["identification"]["searches"] == ["command_driven"]


def test_without_settings_the_scenario_is_left_as_it_is_and_by_an_identification_that_fails_the_result_too(
    recorded_folder,
):
    mine = "# mine\n" + SHORT.to_toml()
    recorded_folder.scenario.write_text(mine, encoding="utf-8")
    with pytest.raises(ScenarioError, match="robot rss6 has no parameter set 'nobody'; it has identified"):
        pipeline.identify(recorded_folder.path, SilentProgress(), {"model.start_parameters": "nobody"})
    assert not recorded_folder.result.exists()
    pipeline.identify(recorded_folder.path, SilentProgress())
    assert recorded_folder.scenario.read_text(encoding="utf-8") == mine
    result = load_result(recorded_folder.result)
    assert result["settings"] == estimator_settings(SHORT)
    assert changed_settings_table(result, SHORT.to_toml()).rows == ()
    assert changed_settings_table({}, "").rows == ()


def test_what_the_record_was_made_with_is_refused_in_one_line_and_every_setting_of_the_sections_is_listed(
    recorded_folder, capfd
):
    for setting in ({"timing.latency_s": 0.01}, {"sensor": "ctrack780"}, {"identification": {}}):
        with pytest.raises(ScenarioError, match=f"'{next(iter(setting))}' cannot be set for an identification"):
            with_estimator_settings(SHORT, setting)
    with pytest.raises(ScenarioError, match=r"valid names in \[identification\]: method, scale_anchor"):
        with_estimator_settings(SHORT, {"identification.methode": "closed_loop"})
    assert command("identify", "--out", recorded_folder.path, "--set", "identification.scale_anchor=prior") == 1
    said = one_line(capfd.readouterr().err)
    assert "'identification.scale_anchor' cannot be set for an identification" in said
    assert "allowed: identification.*, model.*, filter.*, except identification.scale_anchor and" in said
    assert not recorded_folder.result.exists()
    listed = {key.partition(".")[0] for key in estimator_settings(SHORT)}
    assert listed == set(SECTIONS) < set(Scenario.model_fields)


def test_the_report_says_what_was_set_anew(run_folder):
    """The scenario that it shows is that of the record."""
    data = read_report_data(run_folder)
    assert [table.title for table in provenance_section(data).tables] == ["Time of the stages", "Scenario", "Software"]
    data.result["settings"] = {"model.steps_per_frame": 9, "filter.order": 8, "identification.anchor_std": 0.1}
    _, changed, scenario, _ = provenance_section(data).tables
    assert changed.rows == (("model.steps_per_frame", "9", "4"), ("identification.anchor_std", "0.1", "-"))
    assert ("model.steps_per_frame", "4") in [row[:2] for row in scenario.rows]
