"""Figures: the numbers behind them, their labels and units, their files."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from random_actors import random_actor
from safetensors.numpy import save_file

from imujoco_minari import combine_datasets, publish
from imujoco_minari.cli.app import run
from imujoco_minari.envs.mjcf import variant_model
from imujoco_minari.errors import DatasetError, DependencyError
from imujoco_minari.pictures.plotting.datasets import (
    FIGURES,
    Series,
    action_labels,
    labels,
    load_series,
    observation_labels,
    plot_datasets,
    with_bases,
)
from imujoco_minari.pictures.plotting.scores import plot_scores
from imujoco_minari.pictures.plotting.style import COLOURS, line_style, save
from imujoco_minari.pictures.plotting.transfer import draw_transfer, plot_transfer
from imujoco_minari.policies.evaluation import Evaluation
from imujoco_minari.policies.transfer import Transfer, columns
from imujoco_minari.variants import ROBOTS, Variant, specification

pytest.importorskip("matplotlib")

LEG = Variant.parse("hopper-massdec_25_leggeom")
LONG = Variant.parse("hopper-lengthinc_50_leggeom")


@pytest.fixture
def series() -> list[Series]:
    ids = [publish(variant, tier="random", episodes=4).dataset_id for variant in (LEG, LONG, LEG.base)]
    return with_bases([load_series(dataset_id) for dataset_id in ids])[0]


# What the columns are


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_column_has_a_name_and_a_unit(robot: str) -> None:
    observations, actions = observation_labels(robot), action_labels(robot)
    assert (len(observations), len(actions)) == specification(robot).sizes
    assert len({*observations, *actions}) == sum(specification(robot).sizes)
    assert {label.rpartition(" ")[2] for label in observations} == {"(m)", "(rad)", "(m/s)", "(rad/s)"}


@pytest.mark.parametrize(
    ("robot", "first"),
    [
        ("swimmer", "angle of free_body_rot (rad)"),
        ("ant", "z of root (m)"),
        ("humanoid", "z of root (m)"),
    ],
)
def test_the_columns_of_other_robots_are_positions_and_then_velocities(robot: str, first: str) -> None:
    names, page = observation_labels(robot), specification(robot)
    positions, velocities = names[: page.observed_positions], names[page.observed_positions :]
    assert positions[0] == first
    assert len(set(names)) == len(names) <= page.observation_size
    assert len(velocities) == variant_model(Variant(robot)).nv
    assert [name for name in names if name.startswith("velocity ")] == velocities


def test_the_columns_are_in_the_order_of_the_environment() -> None:
    names = observation_labels("hopper")
    assert names[:2] == ["position of rootz (m)", "angle of rooty (rad)"]
    assert names[4:7] == ["angle of foot_joint (rad)", "velocity of rootx (m/s)", "velocity of rootz (m/s)"]
    assert action_labels("halfcheetah")[2] == "action on bfoot (1 = 60 N m)"


# What is compared


def test_the_base_of_the_same_tier_is_found_and_comes_first(series: list[Series]) -> None:
    assert labels(series) == [
        "hopper-base-random",
        "hopper-massdec_25_leggeom-random",
        "hopper-lengthinc_50_leggeom-random",
    ]
    _, alone, _ = series
    ordered, missing = with_bases([alone])
    assert labels(ordered) == ["hopper-base-random", "hopper-massdec_25_leggeom-random"]
    assert missing == []


def test_a_base_that_is_not_published_is_told() -> None:
    one = load_series(publish(LEG, tier="random", episodes=2).dataset_id)
    ordered, missing = with_bases([one])
    assert ordered == [one]
    assert missing == ["imujoco/hopper-base-random-v0"]


def test_a_collection_is_one_series() -> None:
    ids = [publish(variant, tier="random", episodes=2).dataset_id for variant in (LEG, LONG)]
    combine_datasets(ids, "imujoco/hopper-mine-v0")
    one = load_series("imujoco/hopper-mine-v0")
    assert labels([one]) == ["hopper-mine"]
    assert (one.robot, one.is_base, one.data.episodes) == ("hopper", False, 4)


def test_datasets_of_one_name_have_their_whole_ids(root: Path, series: list[Series]) -> None:
    base, leg, _ = series
    shutil.copytree(root / leg.dataset_id, root / "mine" / "hopper-massdec_25_leggeom-random-v0")
    drawn = [base, leg, load_series("mine/hopper-massdec_25_leggeom-random-v0")]
    names = ["hopper-base-random", leg.dataset_id, "mine/hopper-massdec_25_leggeom-random-v0"]
    figure = FIGURES["returns"](drawn)
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == [f"{name}  (n = 4)" for name in names]
    figure.draw_without_rendering()
    label = axes.xaxis.label.get_window_extent()
    assert figure.bbox.x0 <= label.x0 < label.x1 <= figure.bbox.x1
    (legend,) = FIGURES["actions"](drawn).legends
    assert [text.get_text() for text in legend.get_texts()] == names


def test_datasets_of_two_robots_are_refused(series: list[Series], tmp_path: Path) -> None:
    other = load_series(publish("walker2d-base", tier="random", episodes=1).dataset_id)
    with pytest.raises(DatasetError, match="a plot is of one robot"):
        plot_datasets([*series, other], tmp_path)
    assert list(tmp_path.glob("*.png")) == []


# What is drawn


def test_the_dots_are_the_episodes(series: list[Series]) -> None:
    for name, values in (
        ("returns", [one.data.returns for one in series]),
        ("lengths", [one.data.episode_lengths for one in series]),
    ):
        (axes,) = FIGURES[name](series).axes
        dots = [line for line in axes.lines if line.get_marker() == "."]
        for line, numbers in zip(dots, values, strict=True):
            assert np.array_equal(np.asarray(line.get_xdata()), numbers)
        medians = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
        assert medians == pytest.approx([float(np.median(numbers)) for numbers in values])
        assert [label.get_text() for label in axes.get_yticklabels()] == [
            f"{label}  (n = 4)" for label in labels(series)
        ]


def test_every_axis_says_what_it_shows_and_in_which_unit(series: list[Series]) -> None:
    assert "(reward)" in FIGURES["returns"](series).axes[0].get_xlabel()
    assert "(steps)" in FIGURES["lengths"](series).axes[0].get_xlabel()
    actions = [axes.get_xlabel() for axes in FIGURES["actions"](series).axes]
    assert actions == action_labels("hopper")
    panels = [axes for axes in FIGURES["observations"](series).axes if axes.get_visible()]
    assert [axes.get_xlabel() for axes in panels] == observation_labels("hopper")
    assert panels[0].get_ylabel() == "share of steps (%)"


def test_the_shares_of_a_distribution_add_up_and_the_base_is_filled(series: list[Series]) -> None:
    from matplotlib.patches import StepPatch

    figure = FIGURES["observations"](series)
    for axes in (axes for axes in figure.axes if axes.get_visible()):
        steps = [patch for patch in axes.patches if isinstance(patch, StepPatch)]
        assert [patch.get_fill() for patch in steps] == [True, False, False]
        for patch in steps:
            assert patch.get_data().values.sum() == pytest.approx(100.0)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == labels(series)


def test_a_column_that_never_changes_can_be_drawn(series: list[Series]) -> None:
    for one in series:
        one.data.observations[:, 3] = 1.5
    assert FIGURES["observations"](series).axes[3].get_xlim() == (1.0, 2.0)


def test_lines_differ_in_colour_and_in_dash() -> None:
    styles = [tuple(line_style(number).values()) for number in range(12)]
    assert len(set(styles)) == 12
    assert all(styles[n][0] != styles[n + 1][0] and styles[n][1] != styles[n + 1][1] for n in range(11))
    assert len(set(COLOURS)) == len(COLOURS)


def test_each_figure_is_a_png_and_an_svg_and_the_same_when_drawn_again(
    series: list[Series], tmp_path: Path
) -> None:
    seen: list[int] = []
    files = plot_datasets(series, tmp_path / "a", on_figure=lambda: seen.append(1))
    assert len(seen) == len(FIGURES) == 4
    assert [file.name for file in files] == [
        f"{name}.{ending}" for name in FIGURES for ending in ("png", "svg")
    ]
    for file in files:
        if file.suffix == ".png":
            with Image.open(file) as picture:
                assert picture.width > 500
        else:
            words = " ".join(ElementTree.parse(file).getroot().itertext())
            assert "hopper-base-random" in words
    again = save(FIGURES["returns"](series), tmp_path / "b" / "returns")
    assert [file.read_bytes() for file in files[:2]] == [file.read_bytes() for file in again]


# Scores


def test_a_method_that_one_panel_lacks_is_in_the_legend(tmp_path: Path) -> None:
    one, both = {"told": [(0.5, 0.4, 0.6)]}, {"told": [(0.5, 0.4, 0.6)], "mine": [(0.2, 0.1, 0.2)]}
    for x_label in ("steps", ""):
        _, svg = plot_scores({"a": one, "b": both}, ["25"], ("Scores", x_label, "score"), tmp_path / "scores")
        words = " ".join(ElementTree.parse(svg).getroot().itertext()).split()
        assert words.count("told") == words.count("mine") == 1
        assert x_label in words or not x_label


# Transfer


def made_up(policies: tuple[str, ...], variants: tuple[Variant, ...]) -> Transfer:
    cells = {
        (policy, variant): Evaluation(np.array([100.0 * row + column]), np.array([10]), (str(variant),))
        for row, policy in enumerate(policies)
        for column, variant in enumerate(variants)
    }
    return Transfer(policies, variants, cells)


def test_the_matrix_has_a_row_a_policy_and_columns_by_category(tmp_path: Path) -> None:
    variants = columns("hopper")
    policies = tuple(str(variant) for variant in variants)
    transfer = made_up(policies, variants)
    axes, bar = draw_transfer(transfer).axes
    assert np.array_equal(np.asarray(axes.images[0].get_array()), transfer.returns())
    assert [text.get_text() for text in axes.texts] == ["base", "mass", "joint", "length", "friction"]
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert labels[:3] == ["base", "torsogeom -50 %", "torsogeom -25 %"]
    assert [label.get_text() for label in axes.get_yticklabels()][1] == "massdec_50_torsogeom"
    assert "(reward)" in bar.get_ylabel()
    (circles,) = [line for line in axes.lines if line.get_marker() == "o"]
    assert list(circles.get_xdata()) == list(circles.get_ydata()) == list(range(38))
    files = plot_transfer(transfer, tmp_path / "transfer")
    assert [file.name for file in files] == ["transfer.png", "transfer.svg"]
    assert all(file.stat().st_size > 1000 for file in files)


def test_a_small_matrix_has_its_numbers_in_it() -> None:
    axes = draw_transfer(made_up(("mine", "hopper-base"), columns("hopper", "friction"))).axes[0]
    words = [text.get_text() for text in axes.texts]
    assert words == ["base", "friction", "0", "1", "2", "3", "100", "101", "102", "103"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["mine", "base"]


# The command


def test_the_command_plots_and_tells_of_a_missing_base(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset_id = publish(LEG, tier="random", episodes=2).dataset_id
    assert run(["plot", dataset_id, "--output", str(tmp_path / "plots"), "--json"]) == 0
    told = capsys.readouterr()
    assert "imujoco/hopper-base-random-v0 is not in the Minari root" in told.err
    assert len(json.loads(told.out)["files"]) == len(list((tmp_path / "plots").iterdir())) == 8
    assert run(["plot", "imujoco/hopper-base-v0"]) == 2
    assert "is not in the Minari root" in capsys.readouterr().err


def test_policies_of_one_name_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / folder / "mine.safetensors" for folder in ("a", "b")]
    for path in paths:
        path.parent.mkdir()
        save_file(dict(random_actor(11, 3).weights), path)
    output = tmp_path / "transfer"
    command = ["transfer", "-r", "hopper", "-c", "friction", "-n", "1", "-o", str(output)]
    assert run([*command, *(word for path in paths for word in ("--policy", str(path)))]) == 1
    assert f"{paths[0]} and {paths[1]} have the same name, mine: rename" in capsys.readouterr().err
    assert not output.exists()
    assert run([*command, "--policy", str(paths[0]), "--policy", str(paths[0]), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["policies"] == ["mine"]


def test_a_missing_matplotlib_is_named_with_its_remedy(
    series: list[Series], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(DependencyError, match=r'pip install "imujoco-minari\[plot\]"'):
        FIGURES["returns"](series)
