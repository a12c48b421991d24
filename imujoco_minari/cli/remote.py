"""``imujoco push`` and ``imujoco pull``: datasets to and from Minari's remotes."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated

import typer

from imujoco_minari.cli.app import AsJson, Category, Robot, app, fail, out, print_json, progress, say
from imujoco_minari.cli.datasets import Tier
from imujoco_minari.errors import DatasetNotFoundError, RemoteError, VariantError
from imujoco_minari.variants import EXPERT

if TYPE_CHECKING:
    from imujoco_minari.remotes import Pulled, Pushed

Remote = Annotated[
    str | None, typer.Option("--remote", help="hf://user or gcp://bucket; else MINARI_REMOTE is taken.")
]
Token = Annotated[
    str | None, typer.Option("--token", help="Hugging Face token, or a service account's key file.")
]
Force = Annotated[bool, typer.Option("--force", help="Replace what has one of the ids.")]


@app.command("push")
def push_datasets(
    ids: Annotated[list[str] | None, typer.Argument(help="Dataset ids.")] = None,
    remote: Remote = None,
    robot: Robot = None,
    category: Category = None,
    tier: Tier = EXPERT,
    token: Token = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Upload datasets to a remote, with a card each.

    Digests are checked before, and what the remote holds is read back and compared after. What is there
    already is left alone, so an interrupted push goes on where it was. With --robot, all datasets of
    the catalogue that are published here.

    Examples: `imujoco push imujoco/hopper-massdec_25_leggeom-v0 --remote hf://user`,
    `imujoco push --robot hopper --remote gcp://bucket`
    """
    from imujoco_minari.publishing.combiner import published_ids
    from imujoco_minari.remotes import push_all

    if ids and (robot or category):
        raise VariantError("give dataset ids or --robot, not both")
    if not ids:
        if robot is None:
            raise VariantError("give dataset ids, or --robot")
        ids = published_ids(robot, category, tier)
        if not ids:
            raise DatasetNotFoundError(f"no {tier} dataset of {robot} is published here")
    address = _address(remote)
    outcomes: list[Pushed | Pulled] = []
    with progress(f"pushing to {address}", len(ids), quiet=as_json) as advance:
        for pushed in push_all(ids, address, token=token, force=force):
            outcomes.append(pushed)
            if not as_json and not pushed.error:
                out.print(
                    f"pushed {pushed.dataset_id} to {address}: {pushed.bytes / 1e6:.1f} MB, "
                    f"read back and equal, in {pushed.seconds:.1f} s"
                    if pushed.uploaded
                    else f"left alone {pushed.dataset_id}: {address} has the same already"
                )
            advance()
    _finish(outcomes, as_json)


@app.command("pull")
def pull_datasets(
    ids: Annotated[list[str], typer.Argument(help="Dataset ids.")],
    remote: Remote = None,
    token: Token = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Download datasets from a remote, and check every digest before one is visible.

    A dataset that is here already is left alone. The datasets that a collection is made of come with it;
    --force does not replace them.

    Example: `imujoco pull imujoco/hopper-massdec_25_leggeom-v0 --remote hf://user`
    """
    from imujoco_minari.remotes import pull_all

    address = _address(remote)
    outcomes: list[Pushed | Pulled] = []
    with progress(f"pulling from {address}", len(ids), quiet=as_json) as advance:
        for pulled in pull_all(ids, address, token=token, force=force):
            outcomes.append(pulled)
            if not as_json and not pulled.error:
                _report_pull(pulled)
            advance()
    _finish(outcomes, as_json)


def _report_pull(pulled: Pulled) -> None:
    if not pulled.downloaded:
        out.print(f"left alone {pulled.dataset_id}: it is here already, at {pulled.path}")
        return
    out.print(
        f"pulled {pulled.dataset_id}, checked, in {pulled.seconds:.1f} s\n  at {pulled.path}"
        + (
            ""
            if pulled.same_simulator
            else "\n  made with another simulator: its replay will not be exact here"
        )
    )


def _address(remote: str | None) -> str:
    address = remote or os.environ.get("MINARI_REMOTE")
    if not address:
        raise RemoteError("name a remote with --remote, or in MINARI_REMOTE: hf://<user> or gcp://<bucket>")
    return address


def _finish(outcomes: list[Pushed | Pulled], as_json: bool) -> None:
    if as_json:
        print_json([vars(outcome) for outcome in outcomes])
    failures = [outcome for outcome in outcomes if outcome.error]
    for outcome in failures:
        fail(
            outcome.error if outcome.dataset_id in outcome.error else f"{outcome.dataset_id}: {outcome.error}"
        )
    if len(outcomes) > 1:
        say(f"{len(outcomes) - len(failures)} done, {len(failures)} failed")
    if failures:
        raise typer.Exit(1)
