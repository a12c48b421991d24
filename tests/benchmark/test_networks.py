"""Networks: their arithmetic against NumPy's, and descent from checkpoint to checkpoint."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from imujoco_minari.benchmark import networks
from imujoco_minari.loading import Statistics

RNG = np.random.default_rng(0)


def test_an_actor_normalises_and_squashes_as_the_network_was_trained() -> None:
    network = networks.new_network((3, 8, 8, 2), seed=1)
    statistics = Statistics(np.array([1.0, -2.0, 0.5]), np.array([0.5, 2.0, 1.0]))
    observations = RNG.normal(size=(5, 3))
    expected = np.tanh(networks.forward(network, (observations - statistics.mean) / statistics.std))
    actor = networks.to_actor(network, statistics, "test")
    found = np.array([actor.act(row, RNG) for row in observations])
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_an_actor_becomes_a_network_and_again_the_same_actor() -> None:
    actor = networks.to_actor(
        networks.new_network((3, 8, 2), seed=1), Statistics(np.zeros(3), np.ones(3)), "x"
    )
    again = networks.to_actor(networks.of_actor(actor), Statistics(np.zeros(3), np.ones(3)), "x")
    assert again.sha256 == actor.sha256


def test_bound_inputs_are_constant_inputs() -> None:
    network = networks.new_network((5, 8, 2), seed=2)
    free, fixed = RNG.normal(size=(4, 3)), RNG.normal(size=2)
    whole = np.concatenate((free, np.tile(fixed, (4, 1))), axis=1)
    bound = networks.bind(network, fixed)
    np.testing.assert_allclose(networks.forward(bound, free), networks.forward(network, whole), rtol=1e-6)


def test_padding_is_never_drawn_and_a_checkpoint_does_not_depend_on_the_others() -> None:
    """The padding is NaN here, so one drawn row of it would spread to every weight."""
    inputs, actions = RNG.normal(size=(5, 3)), np.tanh(RNG.normal(size=(5, 2)))
    network = networks.new_network((3, 8, 2), seed=3)
    data: tuple[Any, ...] = (networks.padded(inputs), networks.padded(actions), 5)
    assert len(data[0]) == 1024
    data[0][5:] = np.nan
    loss = networks.cloning_loss(4)
    often = networks.descend(loss, network, data, [0, 2, 7], rate=0.01, seed=0)
    once = networks.descend(loss, network, data, [7], rate=0.01, seed=0)
    assert np.isfinite(often[7][0][0]).all()
    for (w, b), (v, c) in zip(often[7], once[7], strict=True):
        np.testing.assert_array_equal(w, v)
        np.testing.assert_array_equal(b, c)
    np.testing.assert_array_equal(often[0][0][0], network[0][0])


def test_cloning_learns_the_actions() -> None:
    inputs = RNG.normal(size=(200, 3)).astype(np.float32)
    actions = np.tanh(inputs @ np.array([[1.0], [-1.0], [0.5]])).astype(np.float32)
    network = networks.new_network((3, 32, 1), seed=0)
    data = (networks.padded(inputs), networks.padded(actions), len(inputs))
    found = networks.descend(networks.cloning_loss(64), network, data, [0, 300], rate=0.01, seed=0)
    before, after = (
        float(((np.tanh(networks.forward(found[steps], inputs)) - actions) ** 2).mean()) for steps in (0, 300)
    )
    assert after < 0.01 < before


@pytest.mark.parametrize(("initial", "variance"), [("lecun", 1 / 400), ("pytorch", 1 / 1200)])
def test_initial_weights_are_uniform_and_have_their_variance(
    initial: networks.Initial, variance: float
) -> None:
    (weight, bias), _ = networks.new_network((400, 2000, 1), seed=4, initial=initial)
    assert np.abs(weight).max() == pytest.approx((3 * variance) ** 0.5, rel=1e-4)
    assert weight.var() == pytest.approx(variance, rel=0.01)
    assert bias.var() == pytest.approx(0.0 if initial == "lecun" else variance, rel=0.1)
    assert weight.dtype == bias.dtype == np.float32


@pytest.mark.parametrize("counts", [(1, 3), (2, 2)])
def test_rows_are_drawn_within_their_blocks(counts: tuple[int, int]) -> None:
    jax = networks.import_jax()
    starts = np.array([0, counts[0]], np.int32)
    key = jax.random.key(0)
    chosen, rows = networks.draw_variants(key, jax.numpy.asarray(starts), jax.numpy.asarray(counts), 20, 50)
    assert set(chosen.tolist()) == {0, 1}
    blocks = [set(range(counts[0])), set(range(counts[0], 4))]
    assert [set(block) for block in rows.tolist()] == [blocks[place] for place in chosen.tolist()]
