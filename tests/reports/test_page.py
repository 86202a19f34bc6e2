"""The report of all four experiments: complete, self-contained, linked to its records, and plain about its limits."""

import csv
import re

import pytest

from gvz.core.errors import ConfigError
from gvz.reports.page import make_report

FIGURES = {
    *("training_difficulty_defend_the_center_levels", "training_difficulty_defend_the_center_level_1"),
    *(f"training_set_size_defend_the_center_{t}" for t in ("gore_mossy_bricks", "complete")),
    *(f"algorithm_comparison_defend_the_center_{t}" for t in ("gore_mossy_bricks", "complete")),
    "rainbow_evaluation_defend_the_center_levels",
    *("defend_the_center_heat_map", "defend_the_center_histogram_0", "defend_the_center_rewards"),
}


def test_every_figure_is_there_in_three_forms(report_of_all):
    page = (report_of_all / "report.html").read_text()
    shown = set(re.findall(r'<figure id="figure-([^"]+)"', page))
    assert shown >= FIGURES
    for suffix, begins in (("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")):
        files = {file.stem: file for file in (report_of_all / "figures").glob(f"*.{suffix}")}
        assert set(files) == shown
        assert all(file.read_bytes().startswith(begins) for file in files.values())


def test_the_page_loads_nothing(report_of_all):
    page = (report_of_all / "report.html").read_text()
    assert not re.findall(r'(?:src|srcset|data)="(?!data:)[^"]*"', page)
    assert not re.findall(r"<(?:script|link(?! rel=\"icon\" href=\"data:)|iframe)", page)
    assert "@import" not in page
    assert "url(" not in page


def test_every_link_leads_to_a_file_or_a_place_on_the_page(report_of_all):
    page = (report_of_all / "report.html").read_text()
    links = re.findall(r'<a href="([^"]+)"', page)
    places = set(re.findall(r' id="([^"]+)"', page))
    assert any(link.endswith("gore.mp4") for link in links)
    assert any(link.endswith("evaluation.jsonl") for link in links)
    for link in links:
        assert link[1:] in places if link.startswith("#") else (report_of_all / link).exists(), link


def test_tables_of_all_experiments_are_files_too(report_of_all):
    for name in ("training_difficulty", "training_set_size", "algorithm_comparison", "rainbow_evaluation"):
        assert "thesis" in (report_of_all / "tables" / f"{name}.csv").read_text()
        assert r"\textit{thesis}" in (report_of_all / "tables" / f"{name}.tex").read_text()
    assert "LevDoom" in (report_of_all / "tables" / "algorithm_comparison.csv").read_text()


def test_runs_are_listed_with_the_machine_and_software_they_were_trained_on(report_of_all):
    head, *machines = csv.reader((report_of_all / "tables" / "machines.csv").read_text().splitlines())
    assert head == ["runs", "processor", "cores", "memory", "devices", "commit", "versions"]
    [(runs, *told)] = machines  # one seed at this scale, all on one machine
    assert re.fullmatch(r"\d+ runs", runs)
    assert told == [*("Some CPU, Linux x86_64", "2", "8 GiB", "cpu: cpu", "0123456789ab", "python 3.11.2, jax 0.7.0")]


def test_the_head_says_what_the_numbers_cannot_show(report_of_all):
    text = (report_of_all / "report.md").read_text()
    head = text.partition("## ")[0]
    assert "Scale 0.0001: budgets, episodes and grid are shrunk. This shows that the pipeline works" in head
    assert "Fewer than 10 training seeds of dqn_4task, rainbow_4task" in head
    assert "Training set size: 1 of 3 runs are not there yet." in head
    assert "| Defend the Center | ours |" in text
    assert "- (0 of 1 seeds)" in text  # the cell of eight training tasks


def test_nothing_to_report_is_an_error_that_says_what_was_found(tmp_path):
    (tmp_path / "r").mkdir()
    with pytest.raises(ConfigError, match=r"report: nothing to report in .*/r"):
        make_report([tmp_path / "r"], tmp_path / "out")
    (tmp_path / "r" / "random.jsonl").write_text('{"schema": 7}\n')
    with pytest.raises(ConfigError, match=r"nothing to report(.|\n)*line 1: schema 7, want 1"):
        make_report([tmp_path / "r"], tmp_path / "out")


def test_a_place_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "out").touch()
    row = '{"schema": 1, "player": "random", "task": "seek_and_kill/red", "episode": 0, "seed": 1, "score": 3}\n'
    (tmp_path / "random.jsonl").write_text(row)
    with pytest.raises(ConfigError, match=r"--out: .*out cannot be written: (File exists|Not a directory)"):
        make_report([tmp_path / "random.jsonl"], tmp_path / "out")


def test_results_of_one_experiment_twice_are_an_error(tmp_path):
    row = '{"schema": 1, "player": "random", "task": "seek_and_kill/red", "episode": 0, "seed": 1, "score": 3}\n'
    plan = '{"schema": 2, "scale": 1, "experiments": {"quick_comparison": null}}'
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "random.jsonl").write_text(row)
        (tmp_path / name / "plan.json").write_text(plan)
    with pytest.raises(ConfigError, match="more than one of the paths has results of quick_comparison"):
        make_report([tmp_path / "a", tmp_path / "b"], tmp_path / "out")
    (tmp_path / "b" / "plan.json").unlink()
    files, _ = make_report([tmp_path / "a", tmp_path], tmp_path / "out")  # what two of them hold is there once
    assert files[0].read_text().count("Experiment “") == 1


def test_figures_of_an_earlier_report_are_named_and_stay(tmp_path):
    row = '{"schema": 1, "player": "random", "task": "seek_and_kill/red", "episode": 0, "seed": 1, "score": 3}\n'
    (tmp_path / "random.jsonl").write_text(row)
    (tmp_path / "figures").mkdir()
    earlier = [tmp_path / "figures" / f"{n}.png" for n in range(5)]
    for file in earlier:
        file.touch()
    _, (note,) = make_report([tmp_path / "random.jsonl"], tmp_path)
    assert note.endswith("that are not of this report: 0.png, 1.png, 2.png and 2 more; they are left as they are")
    assert all(file.exists() for file in earlier)
