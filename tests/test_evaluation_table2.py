"""Table II: statistics against known values, its rows, its tables from outcomes made up for the purpose."""

import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from app import cli
from app.commands import parse
from app.commands.study import StudyTable2
from ddgrasp import artifacts, attempts
from ddgrasp.config_hash import config_hash
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from ddgrasp.shipped import PRETRAINED
from demos.stage import STORE
from demos.store import EpisodeStore
from deploy.trial_log import TrialLog, read_log
from deploy.trials import TrialResult
from deploy_support import write_policy
from evaluation import paired, rig_trials
from evaluation.failure_modes import MODES
from evaluation.rig_trials import Series
from evaluation.table2 import page, results, rows
from evaluation.table2.rows import ROWS, TABLES
from evaluation.treatments import TreatmentName
from foundation import store

LAPTOP = get_preset("laptop")


# --- statistics ----------------------------------------------------------------------------------


def test_mcnemar_s_exact_p_is_that_of_published_tables():
    # Fagerland, Lydersen and Laake (2013), Table 1 after Bentur et al. (2009): 1 and 7 discordant pairs
    assert paired.mcnemar_exact(1, 7) == pytest.approx(0.0703, abs=5e-5)
    # by hand: 2 (C(6, 0) + C(6, 1)) / 2^6
    assert paired.mcnemar_exact(5, 1) == 14 / 64
    assert paired.mcnemar_exact(10, 0) == 2 / 1024


def test_mcnemar_s_p_is_one_without_evidence_and_does_not_mind_the_order():
    assert paired.mcnemar_exact(0, 0) == paired.mcnemar_exact(4, 4) == 1.0
    for b in range(12):
        for c in range(12):
            assert paired.mcnemar_exact(b, c) == paired.mcnemar_exact(c, b) <= 1.0
    assert 0 < paired.mcnemar_exact(0, 600) < 1e-100
    with pytest.raises(ValueError, match="-1 and 2 pairs differ"):
        paired.mcnemar_exact(-1, 2)


def test_holm_s_step_down():
    # by Holm (1979): 4 * 0.005, 3 * 0.01, 2 * 0.03, and no less than the one before for 0.04
    adjusted = paired.holm([0.01, 0.04, 0.03, 0.005])
    assert adjusted == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert paired.holm([0.6, 0.5]) == [1.0, 1.0]
    assert paired.holm([]) == [] and paired.holm([0.2]) == [0.2]


# --- rows ----------------------------------------------------------------------------------------


def test_the_main_table_is_the_paper_s_with_hand_made_noise_off():
    shared = LAPTOP
    assert [ROWS[name].source for name in TABLES["main"].rows] == [
        "ideal", "dextrah", "ideal", "monocular", "learned_ungrafted", "learned", "rig",
    ]  # fmt: skip
    for name in TABLES["main"].rows:
        made = rows.row_config(shared, ROWS[name])
        assert made.student.training.disparity_noise_px == 0.0 and made.ddg == LAPTOP.ddg
        assert made.student.depth_source == ROWS[name].source
        recipe = LAPTOP.student  # one for all, but for who fills the holes
        assert not made.student.picture.fill_holes
        assert recipe == replace(
            made.student, depth_source="learned", training=recipe.training, picture=recipe.picture
        )
    assert {name: ROWS[name].depth for name in TABLES["main"].rows if ROWS[name].depth != "recorded"} == {
        "inpaint": "inpaint",
        "monocular": "monocular",
    }


def test_rows_differ_in_the_student_s_section_alone_so_that_they_share_what_comes_before():
    shared = LAPTOP
    for row in ROWS.values():
        made = rows.row_config(shared, row)
        stages = (
            ("teacher", "demos", "record") if row.paper_generator else ("teacher", "demos", "record", "ddg")
        )
        for stage in stages:
            assert config_hash(made, stage) == config_hash(shared, stage)
    by_student = {}
    for row in ROWS.values():
        by_student.setdefault(row.student, set()).add(config_hash(rows.row_config(shared, row), "student"))
    assert all(len(hashes) == 1 for hashes in by_student.values())
    assert len(set().union(*by_student.values())) == len(by_student)
    assert ROWS["inpaint"].student == ROWS["sim_gt"].student
    farther = replace(ROWS["rand_noise_normal"], dextrah_normal_m=0.02)
    assert farther.student != ROWS["rand_noise_normal"].student


def test_rows_with_holes_cut_by_hand_differ_in_them_alone():
    shared = LAPTOP
    for name in ("sim_gt", "rand_noise", "ddg"):
        plain, holed = (rows.row_config(shared, ROWS[row]).student for row in (name, f"{name}_ellipses"))
        assert (plain.ellipse_dropout, holed.ellipse_dropout) == (0.0, rows.ELLIPSES)
        assert replace(holed, ellipse_dropout=0.0) == plain
    for name in ("sim_gt", "rand_noise"):
        filled, holed = (
            rows.row_config(shared, ROWS[f"{name}{kind}_filled"]).student for kind in ("", "_ellipses")
        )
        assert filled.picture.fill_holes and replace(holed, ellipse_dropout=0.0) == filled


def test_ripple_filled_differs_from_ripple_in_who_fills_the_holes():
    shared = LAPTOP
    plain, filled = (rows.row_config(shared, ROWS[row]) for row in ("sim_gt_ripple", "sim_gt_ripple_filled"))
    assert plain.student.training == filled.student.training == LAPTOP.student.training
    picture = replace(plain.student.picture, fill_holes=True)
    assert filled == replace(plain, student=replace(plain.student, picture=picture))


def test_ripple_and_the_paper_s_generator_are_one_difference_each():
    shared = LAPTOP
    rippled = rows.row_config(shared, ROWS["ddg_ripple"])
    assert rippled.student.training == LAPTOP.student.training
    assert rippled.student.training.disparity_noise_px == 0.25
    paper = rows.row_config(shared, ROWS["paper_ddg"]).ddg
    assert (paper.depth.representation, paper.training.loss_weight) == ("depth", "uniform")
    assert (paper.training.steps, paper.unet, paper.prior) == (
        LAPTOP.ddg.training.steps, LAPTOP.ddg.unet, LAPTOP.ddg.prior,
    )  # fmt: skip
    assert paper.init_from == ""  # not the shared one's, which draws something else
    assert rows.row_config(shared, ROWS["paper_ddg"], "made").ddg == replace(paper, init_from="made")
    assert rows.row_config(shared, ROWS["ddg"], "made").ddg == LAPTOP.ddg
    no_ripple = replace(LAPTOP.student.training, disparity_noise_px=0.0)
    still = replace(shared, student=replace(shared.student, training=no_ripple))
    with pytest.raises(UserError, match=r"disparity_noise_px is 0: row 'DDG, ripple' needs its strength"):
        rows.row_config(still, ROWS["ddg_ripple"])


def test_a_filled_row_differs_from_its_own_in_who_fills_the_holes():
    shared = LAPTOP
    for name in ("sim_gt", "rand_noise", "ddg"):
        plain, filled = (rows.row_config(shared, ROWS[row]) for row in (name, f"{name}_filled"))
        picture = replace(plain.student.picture, fill_holes=True)
        assert filled == replace(plain, student=replace(plain.student, picture=picture))


def test_students_may_start_from_one_that_saw_clean_depth_alone(tmp_path):
    def student(name: str, init_from: str = "", ellipse_dropout: float = 0.0, **training) -> str:
        config = replace(
            LAPTOP.student, depth_source="ideal", init_from=init_from, ellipse_dropout=ellipse_dropout
        )
        config = replace(
            config, training=replace(config.training, **(dict.fromkeys(rows.HAND_MADE, 0.0) | training))
        )
        whole, folder = replace(LAPTOP, student=config), tmp_path / name / "student"
        folder.mkdir(parents=True)
        artifacts.finish(folder, "student", whole, seconds=1.0, metrics={})
        return str(tmp_path / name)

    def check(start: str) -> None:
        rows.check_shared(replace(LAPTOP, student=replace(LAPTOP.student, init_from=start)))

    check(student("clean"))
    with pytest.raises(
        UserError, match=r"trained with student.training.unseen_share 0.25: a student that has"
    ):
        check(student("holes", unseen_share=0.25))
    with pytest.raises(UserError, match="trained with student.init_from 'pretrained/student'"):
        check(student("later", init_from="pretrained/student"))
    with pytest.raises(UserError, match=r"trained with student.ellipse_dropout 4.0: a student that has"):
        check(student("cut", ellipse_dropout=4.0))


def test_pages_have_words_for_what_every_row_is_trained_on_and_sees():
    assert {row.source for row in ROWS.values()} <= rows.TRAINING.keys()
    assert set(get_args(TreatmentName)) == rows.DEPLOYED.keys()


def test_help_names_every_row_and_table(capsys):
    with pytest.raises(SystemExit):
        parse("study table2", ["--help"])
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert [name for name in (*ROWS, *TABLES) if f" {name}" not in told] == []


def test_rows_are_chosen_by_name_or_by_table():
    assert rows.chosen((), ("main",)) == TABLES["main"].rows
    assert rows.chosen(("ddg", "sim_gt", "ddg"), ("main",)) == ("ddg", "sim_gt")
    assert set(rows.chosen((), tuple(TABLES))) == set(ROWS)
    with pytest.raises(UserError, match=r"--table names none, and --rows neither: give tables \(main"):
        command("--table").planned()


# --- tables --------------------------------------------------------------------------------------


def outcome(index: int, name: str, success: bool) -> TrialResult:
    return TrialResult(index, name, False, success, 60, 0, 0, {}, [], *([] for _ in range(5)))


def write_row(out: Path, series: Series, row: str, wins: dict[str, list[bool]], **header) -> None:
    """The trials of a row as `rig_trials.run` leaves them."""
    folder = results.row_folder(out, results.set_name(series), row)
    folder.mkdir(parents=True)
    belong_to = {"policy_sha256": hashlib.sha256(row.encode()).hexdigest(), "rig": series.rig, "seconds": 6.0}
    header = belong_to | header
    log = TrialLog(folder / rig_trials.TRIALS_FILE, header)
    for place, (name, successes) in enumerate(wins.items()):
        for i, success in enumerate(successes):
            log.append(outcome(1000 * place + i, name, success))


@pytest.fixture
def study(tmp_path) -> dict:
    """DDG wins 10 trials that Sim GT loses and loses one that it wins; Rand Noise was tried on fewer."""
    series = Series("development")
    ddg, sim_gt = [True] * 19 + [False], [True] * 9 + [False] * 10 + [True]
    write_row(tmp_path, series, "ddg", {"apple": ddg[:10], "wheel": ddg[10:]})
    write_row(tmp_path, series, "sim_gt", {"apple": sim_gt[:10], "wheel": sim_gt[10:]})
    write_row(tmp_path, series, "rand_noise", {"apple": [True] * 4})
    about = {"preset": "laptop", "created": "now", "machine": {"processor": "two cores"}}
    return {**about, "left_out": {"monocular": "no <weights>"}, **results.collect(tmp_path)}


def test_rows_are_tested_on_the_trials_that_both_had(study):
    (of,) = study["sets"].values()
    assert list(study["sets"]) == ["development-development-0"]
    assert of["trials"]["seconds"] == 6.0
    by_row = {test["row"]: test for test in of["tables"]["main"]}
    assert set(by_row) == {"sim_gt", "rand_noise"}
    against = by_row["sim_gt"]
    assert (against["n"], against["only_reference"], against["only_row"]) == (20, 10, 1)
    assert against["p"] == 2 * (1 + 11) / 2**11 and against["p_holm"] == 2 * against["p"]
    assert against["difference"] == 9 / 20
    assert (by_row["rand_noise"]["n"], by_row["rand_noise"]["p"]) == (4, 1.0)
    assert of["tables"]["grafting"] == []
    assert of["rows"]["ddg"]["seen"]["n"] == 10 and of["rows"]["ddg"]["unseen"]["successes"] == 9


def test_the_page_says_how_many_holes_were_cut():
    made = {"generator_from": "runs/a", "ellipses": 4.0}
    study = {"rows": {"ddg_ellipses": made}, "sets": {"set": {"rows": {}, "tables": {"ellipses": []}}}}
    cells = {line[0]: line[1] for line in page.table_rows(study, "set", "ellipses")}
    assert cells["DDG, holes cut by hand"] == "generator, grafted (runs/a), 4 elliptic holes a picture"
    assert cells["DDG"] == "generator, grafted"


def test_the_page_has_every_row_tried_or_not(study, tmp_path):
    lines = page.table_rows(study, "development-development-0", "main")
    cells = {line[0]: line for line in lines}
    assert list(cells) == [ROWS[name].title for name in TABLES["main"].rows]
    assert cells["DDG"][6].startswith("95.0 % of 20 (")
    assert cells["Sim GT"][7:] == ("10 / 1 of 20", "0.0117", "0.0234")
    assert cells["Inpaint"][2] == "inpainted on line" and cells["Inpaint"][4] == "not tried"
    names, by_object = page.object_rows(study, "development-development-0")
    assert names == ["apple", "wheel"] and ["Rand Noise", "4 of 4", ""] in by_object
    picture = page.draw(study)
    assert picture[:8] == b"\x89PNG\r\n\x1a\n"
    html = page.render(study, picture)
    assert "10 / 1 of 20" in html and "Monocular left out: no &lt;weights&gt;" in html
    assert html.count("data:image/png;base64,") == 1
    assert "Trials: development rig, development seed 0" in page.render(study, b"")
    (sim_gt,) = (line for line in page.mode_rows(study, "development-development-0") if line[0] == "Sim GT")
    assert dict(zip(MODES, sim_gt[1:], strict=True)) == dict.fromkeys(MODES, "") | {"not recorded": "10"}
    assert "<th>lifted and lost</th>" in html
    text = page.describe(study, "development-development-0")
    assert "Sim GT" in text and "p (Holm) 0.0234" in text and "Inpaint" not in text
    assert TABLES["main"].title in text and TABLES["ripple"].title not in text + html


def test_trials_of_another_policy_than_the_row_has_now_are_not_shown(study, tmp_path):
    """As after a change of what the row's student is trained on."""
    for row, made in (("ddg", b"ddg"), ("rand_noise", b"another")):
        policy = tmp_path / results.STUDENTS / ROWS[row].student / "export" / "policy.onnx"
        policy.parent.mkdir(parents=True)
        policy.write_bytes(made)
    (of,) = results.collect(tmp_path)["sets"].values()
    assert set(of["rows"]) == {"ddg", "sim_gt"} and len(of["tables"]["main"]) == 1


@pytest.mark.parametrize(
    ("otherwise", "differs"),
    [
        ({"rules": 1}, "rules is 1, not 2"),
        ({"seconds": 12.0}, "seconds is 12.0, not 6.0"),
        ({"contact": 100.0}, "contact is 100.0, not 30.0"),
        ({"retry": False}, "retry is False, not True"),
        ({"camera": "ideal"}, "camera is ideal, not stereo"),
        ({"draws_hash": "cd"}, "draws_hash is cd, not ab"),
    ],
)
def test_rows_that_were_tried_otherwise_are_not_compared_which_is_said(tmp_path, otherwise, differs):
    alike = {"rules": 2, "contact": 30.0, "retry": True, "camera": "stereo", "draws_hash": "ab"}
    series = Series("fr3")
    for row, header in (("ddg", alike), ("sim_gt", alike), ("rand_noise", alike | otherwise)):
        write_row(tmp_path, series, row, {"apple": [True, False]}, **header)
    about = {"preset": "laptop", "created": "now", "machine": {"processor": "x"}, "left_out": {}}
    study = {**about, **results.collect(tmp_path)}
    (of,) = study["sets"].values()
    assert set(of["rows"]) == {"ddg", "sim_gt", "rand_noise"}, "its own success is shown"
    assert [test["row"] for test in of["tables"]["main"]] == ["sim_gt"]
    assert of["tables"]["main"][0]["p_holm"] == of["tables"]["main"][0]["p"]
    said = f"Rand Noise was tried otherwise than DDG and is not compared with it: {differs}."
    assert said in page.render(study, b"") and said in page.describe(study, results.set_name(series))
    assert of["apart"]["grafting"] == [] and of["trials"]["seconds"] == 6.0


@pytest.mark.parametrize(("camera", "said"), [("stereo", False), ("other_tables", True)])
def test_the_page_says_that_every_trial_has_a_table_of_its_own(tmp_path, camera, said):
    write_row(tmp_path, Series("development"), "ddg", {"apple": [True]}, camera=camera)
    about = {"preset": "laptop", "created": "now", "machine": {"processor": "x"}, "left_out": {}}
    made = page.render({**about, **results.collect(tmp_path)}, b"")
    assert ("seed 0, each before a table of its own</h2>" in made) == said


def test_the_page_says_that_the_camera_was_set_otherwise(tmp_path):
    series = Series("development")
    write_row(tmp_path, series, "ddg", {"apple": [True]}, stereo=["exposure_target 0.7", "read_noise 0.0"])
    about = {"preset": "laptop", "created": "now", "machine": {"processor": "x"}, "left_out": {}}
    made = page.render({**about, **results.collect(tmp_path)}, b"")
    assert "seed 0, record.stereo set to exposure_target 0.7, read_noise 0.0</h2>" in made


def test_where_the_reference_was_not_tried_the_first_row_says_what_is_otherwise(tmp_path):
    series = Series("development")
    for row, rules in (("sim_gt", 1), ("rand_noise", 2), ("paper_ddg", 2), ("paper_ddg_no_graft", 2)):
        write_row(tmp_path, series, row, {"apple": [True]}, rules=rules, contact=100.0 * rules)
    (of,) = results.collect(tmp_path)["sets"].values()
    assert of["apart"]["main"] == [
        {"row": "rand_noise", "against": "sim_gt", "differs": ["rules is 2, not 1"]}
    ]
    assert [test["row"] for test in of["tables"]["grafting"]] == ["paper_ddg_no_graft"]
    (tmp_path / "two").mkdir()
    write_row(tmp_path / "two", series, "ddg", {"apple": [True]}, rules=2)
    write_row(tmp_path / "two", series, "sim_gt", {"apple": [True]}, rules=1, seconds=9.0)
    (of,) = results.collect(tmp_path / "two")["sets"].values()
    assert of["trials"]["seconds"] == 6.0, "as the main table's reference was"


KEPT = PRETRAINED / "table2" / "trials"


@pytest.mark.skipif(not KEPT.is_dir(), reason="a wheel has no table2")
@pytest.mark.parametrize(
    ("kept", "rows_and_p"),
    [
        ("development-test-10", {"sim_gt": (477, 6), "rand_noise": (50, 23), "inpaint": (125, 19),
                                 "ddg_no_graft": (25, 20), "upper_bound": (16, 22)}),
        ("development-test-11-other-tables", {"sim_gt": (122, 18), "rand_noise": (19, 24),
                                              "inpaint": (90, 21), "ddg_no_graft": (15, 22),
                                              "upper_bound": (14, 23)}),
        ("development-test-12-overexposed", {"rand_noise": (188, 25), "inpaint": (283, 22),
                                             "sim_gt": (469, 8)}),
        ("development-9", {"sim_gt": (499, 3), "rand_noise": (62, 37), "inpaint": (141, 28),
                           "ddg_no_graft": (26, 34), "upper_bound": (24, 42)}),
        ("fr3-test-10", {"sim_gt": (51, 1), "rand_noise": (5, 3), "inpaint": (8, 3),
                         "ddg_no_graft": (0, 1), "upper_bound": (4, 3)}),
        ("fr3-test-3", {"sim_gt": (51, 3), "rand_noise": (4, 3), "inpaint": (10, 5),
                        "ddg_no_graft": (9, 3), "upper_bound": (7, 3)}),
    ],
)  # fmt: skip
def test_the_kept_logs_give_the_pairs_of_the_page(tmp_path, kept, rows_and_p):
    """docs/table2.md."""
    trials = tmp_path / results.TRIALS / "kept-split-0"
    trials.parent.mkdir()
    trials.symlink_to(KEPT / kept, target_is_directory=True)
    (of,) = results.collect(tmp_path)["sets"].values()
    assert _pairs(of["tables"]["main"]) == rows_and_p
    assert not any(of["apart"].values())
    if kept == "development-test-10":
        ripple = _pairs(of["tables"]["ripple"])
        assert (ripple["ddg_ripple"], ripple["rand_noise_ripple"]) == ((19, 23), (46, 21))
        assert ripple["sim_gt_ripple"] == (301, 16)
        assert _pairs(of["tables"]["grafting"]) == {"paper_ddg_no_graft": (217, 26)}
    if kept == "fr3-test-10":
        ours, paper_s = ({t.index: t.success for t in read_log(KEPT / kept / row / "trials.jsonl")[1]}
                         for row in ("ddg", "paper_ddg"))  # fmt: skip
        pairs = paired.compared(ours, paper_s)
        assert (sum(paper_s.values()), pairs["only_reference"], pairs["only_row"]) == (113, 5, 3)
    if kept == "development-test-12-overexposed":
        holes = _pairs(of["tables"]["ellipses"])
        assert [holes[f"{row}_ellipses"] for row in ("sim_gt", "rand_noise", "ddg")] == [
            (62, 37), (42, 42), (30, 43),
        ]  # fmt: skip
        assert _pairs(of["tables"]["formulas"])["rand_noise_normal"] == (125, 9)
        filled = _pairs(of["tables"]["filled"])
        kinds = (
            "rand_noise_filled",
            "sim_gt_ripple_filled",
            "sim_gt_ellipses_filled",
            "sim_gt_filled",
            "ddg",
        )
        assert [filled[row] for row in kinds] == [(27, 16), (29, 19), (228, 3), (309, 4), (49, 21)]


def _pairs(tests: Sequence[dict]) -> dict[str, tuple[int, int]]:
    return {test["row"]: (test["only_reference"], test["only_row"]) for test in tests}


def test_a_study_without_trials_has_a_page(tmp_path):
    about = {"preset": "laptop", "created": "now", "machine": {"processor": "x"}, "left_out": {}}
    empty = {**about, **results.collect(tmp_path)}
    assert empty["sets"] == {} and "Table II" in page.render(empty, page.draw(empty))


def test_both_rigs_and_splits_stand_apart(tmp_path):
    for series in (Series("development"), Series("fr3", split="test", number=3)):
        write_row(tmp_path, series, "ddg", {"apple": [True]})
    (tmp_path / results.TRIALS / ".DS_Store").touch()
    sets = results.collect(tmp_path)["sets"]
    assert list(sets) == ["development-development-0", "fr3-test-3"]


# --- the command before anything runs ------------------------------------------------------------


def command(*args: str) -> StudyTable2:
    made = parse("study table2", ["--preset", "debug", *args])
    assert isinstance(made, StudyTable2)
    return made


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--rows", "ddg", "sim_tg"), "Unknown row 'sim_tg'. Did you mean 'sim_gt'"),
        (("--table", "mian"), "Unknown table 'mian'. Did you mean 'main'"),
        (("--objects", "aple"), "Unknown object 'aple'. Did you mean 'apple'"),
        (("--rows", "monocular"), "depth_anything_v2_small holds no converted weights: get a file"),
        (
            ("--student.init-from", "pretrained/student"),
            "a student that has seen one row's depth is no start",
        ),
        (("--table", "ripple", "--student.training.disparity-noise-px", "0"), "needs its strength"),
        (("--paper-generator", "pretrained/ddg"), "no row asked for has the paper's own generator"),
        (
            ("--table", "grafting", "--paper-generator", "nowhere"),
            "--paper-generator is 'nowhere', which does",
        ),
        (
            ("--table", "grafting", "--paper-generator", "pretrained/ddg"),
            "the paper's is 'uniform': give another",
        ),
    ],
)
def test_wrong_input_is_one_line_before_anything_is_written(args, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(store, "WEIGHTS_DIR", tmp_path / "no weights")
    out = tmp_path / "study"
    status = cli.main(["study", "table2", "--preset", "debug", "--out", str(out), *args])
    told = capsys.readouterr().err
    assert status == 2 and message in told and told.count("\n") == 1
    assert not out.exists()


def test_the_paper_s_generator_is_taken_from_elsewhere_and_stays_the_same(tmp_path):
    def fitted(name: str, **ddg) -> str:
        folder = tmp_path / name / "ddg"
        folder.mkdir(parents=True)
        (folder / "params.msgpack").touch()
        debug = get_preset("debug")
        config = replace(debug, ddg=replace(rows.paper_generator(debug.ddg), **ddg))
        artifacts.finish(folder, "ddg", config, seconds=1.0, metrics={})
        return str(tmp_path / name)

    def planned(*args: str) -> str:
        study = command("--rows", "paper_ddg", "sim_gt", "--out", str(tmp_path / "study"), *args).planned()
        return study.row_config(ROWS["paper_ddg"]).ddg.init_from

    paper, other = fitted("paper"), get_preset("debug").ddg.depth
    assert planned("--paper-generator", paper) == paper and planned() == ""
    another = fitted("another", depth=other)
    with pytest.raises(UserError, match="has ddg.depth.representation .* the same values"):
        planned("--paper-generator", another)
    with pytest.raises(UserError, match=r"--paper-generator is \S+student, which is of stage 'student'"):
        planned("--paper-generator", "pretrained/student")
    begun = command(
        "--rows", "paper_ddg", "--out", str(tmp_path / "begun"), "--paper-generator", paper
    ).planned()
    attempts.begin(tmp_path / "begun" / "paper" / "ddg", "ddg", begun.row_config(ROWS["paper_ddg"]))
    (tmp_path / "begun" / "paper" / "ddg" / "checkpoint").touch()
    with pytest.raises(
        UserError, match=r"paper/ddg was begun with another .*ddg.init_from is '\S+paper' there"
    ):
        command("--rows", "paper_ddg", "--out", str(tmp_path / "begun"), "--resume").planned()
    fitted("study/paper", init_from=paper)  # as the study leaves it when it has taken that one
    assert planned("--paper-generator", paper, "--resume") == paper
    with pytest.raises(
        UserError, match=r"--paper-generator is '', .* was made otherwise \(--paper-generator"
    ):
        planned("--resume")
    shutil.rmtree(paper)
    assert planned("--paper-generator", paper, "--resume") == paper


def test_a_start_that_is_gone_is_missed_by_rows_that_are_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "WEIGHTS_DIR", tmp_path / "no weights")  # row monocular is left out anyway
    out, gone = tmp_path / "study", ("--student.init-from", "runs/no", "--ddg.init-from", "runs/no")

    def finish(folder: Path, stage: str) -> None:
        config = command(*gone).config
        artifacts.finish(folder / stage, stage, config, seconds=1.0, metrics={})

    def planned(*rows: str) -> tuple[str, ...]:
        return command(*gone, "--out", str(out), "--resume", *rows).planned().rows

    for stage in ("teacher", "ddg"):
        finish(out / results.SHARED, stage)
    for name in ("ideal", "dextrah", "learned_ungrafted", "learned"):
        finish(out / results.STUDENTS / name, "student")
    there = ("sim_gt", "rand_noise", "inpaint", "ddg_no_graft", "ddg")
    assert planned("--rows", *there) == there
    with pytest.raises(UserError, match="student.init_from is 'runs/no', which does not exist"):
        planned()
    finish(out / results.STUDENTS / "rig", "student")
    assert planned() == (*there, "upper_bound")


def test_rows_of_the_paper_s_generator_ask_for_the_start_of_the_one_that_all_rows_share(tmp_path):
    gone = ("--out", str(tmp_path), "--ddg.init-from", "runs/no")
    with pytest.raises(UserError, match="ddg.init_from is 'runs/no', which does not exist"):
        command(*gone, "--rows", "paper_ddg").planned()


def test_a_table_without_its_network_is_made_without_that_row_which_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "WEIGHTS_DIR", tmp_path / "no weights")
    study = command("--out", str(tmp_path)).planned()
    assert set(study.left_out) == {"monocular"} and "weights convert FILE" in study.left_out["monocular"]
    assert study.rows == tuple(name for name in TABLES["main"].rows if name != "monocular")
    assert study.config.demos.rgb and study.series.trials == 50


def test_without_colour_there_are_the_rows_that_need_none(tmp_path):
    study = command("--out", str(tmp_path), "--demos.no-rgb").planned()
    assert set(study.left_out) == {"monocular"} and "upper_bound" in study.rows


def test_demos_that_do_not_say_what_they_show_leave_the_upper_bound_out(tmp_path):
    """They are there and finished, from before demos said it."""
    demos = tmp_path / results.SHARED / "demos"
    old = EpisodeStore(demos / STORE, create=True)
    old.append({"held": np.zeros(2, bool)}, {"object_index": np.int32(0)})
    artifacts.finish(demos, "demos", LAPTOP, seconds=1, metrics={})
    study = command("--out", str(tmp_path), "--demos.no-rgb").planned()
    assert "does not say which object of which size" in study.left_out["upper_bound"]
    with pytest.raises(UserError, match=r"collect new ones for student.depth_source 'rig', in another --out"):
        command("--out", str(tmp_path), "--rows", "upper_bound").planned()


def test_a_study_is_continued_only_with_its_own_configuration(tmp_path):
    from app import table2

    first = command("--out", str(tmp_path), "--rows", "ddg").planned()
    table2.check_place(first, resume=False)
    (begun := tmp_path / "shared" / "teacher").mkdir(parents=True)
    (begun / "params").write_text("begun")
    with pytest.raises(UserError, match="holds an unfinished stage: continue with --resume"):
        table2.check_place(first, resume=False)
    more = command("--out", str(tmp_path), "--rows", "sim_gt", "--trials", "99", "--workers", "1").planned()
    table2.check_place(more, resume=True)
    other = command("--out", str(tmp_path), "--rows", "ddg", "--demos.episodes", "9").planned()
    with pytest.raises(UserError, match=r"begun with another configuration .* demos.episodes is 4 there, 9"):
        table2.check_place(other, resume=True)


def test_trials_that_were_begun_otherwise_are_said_before_anything_is_made(tmp_path):
    from app import table2

    study = command("--out", str(tmp_path), "--rows", "sim_gt", "ddg", "--trials", "1").planned()
    exported = tmp_path / results.STUDENTS / ROWS["ddg"].student / "export"
    exported.mkdir(parents=True)
    policy = write_policy(exported / "policy.onnx")
    series, folder = table2._trials(study, "ddg")
    config = study.row_config(ROWS["ddg"])
    header = rig_trials._header(config, policy, series)
    folder.mkdir(parents=True)
    log = folder / rig_trials.TRIALS_FILE
    TrialLog(log, header | {"rules": 1}).append(outcome(0, "apple", True))
    before = log.read_bytes()
    table2.check_place(study, resume=True)  # a policy that may be made anew says nothing yet
    artifacts.finish(exported, "export", config, seconds=1.0, metrics={})
    with pytest.raises(UserError, match=r"ddg/trials.jsonl was begun otherwise: rules is 1 there, \d here"):
        table2.check_place(study, resume=True)
    assert log.read_bytes() == before
    log.unlink()
    TrialLog(log, header).append(outcome(0, "apple", True))
    table2.check_place(study, resume=True)


def test_without_out_a_study_has_a_folder_of_its_own():
    assert command().out == Path("runs") / "table2-debug"
    assert parse("run", ["--preset", "debug"]).out == Path("runs") / "debug"


def test_a_row_without_a_common_trial_is_no_question_that_holm_counts():
    def tried(first: int, won: bool) -> list[TrialResult]:
        return [outcome(first + i, "apple", won) for i in range(8)]

    made = results.compare(
        TABLES["main"], {"ddg": tried(0, True), "sim_gt": tried(0, False), "rand_noise": tried(100, False)}
    )
    assert [row["row"] for row in made] == ["sim_gt"] and made[0]["p_holm"] == made[0]["p"] == 2 / 2**8


def test_rows_without_holes_cut_by_hand_have_none_whatever_the_configuration():
    holed = replace(LAPTOP, student=replace(LAPTOP.student, ellipse_dropout=2.0))
    cut = {name: rows.row_config(holed, row).student.ellipse_dropout for name, row in ROWS.items()}
    assert cut == {name: rows.ELLIPSES * row.ellipses for name, row in ROWS.items()}
