"""``imujoco push`` and ``imujoco pull``: datasets to and from Minari's remotes."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated

from rich import filesize

from imujoco_minari.cli import options
from imujoco_minari.cli.app import advancing, app, gather
from imujoco_minari.cli.options import option, spread
from imujoco_minari.cli.printing import counted, say
from imujoco_minari.cli.selection import DatasetChoice
from imujoco_minari.errors import RemoteError

if TYPE_CHECKING:
    from imujoco_minari.remotes import Pulled, Pushed


@app.command("push")
@spread
def push_datasets(
    remote: options.Remote = None,
    *,
    choice: DatasetChoice,
    with_collections: Annotated[
        bool, option("--with-collections", "Add the collections that combine these datasets.")
    ] = False,
    token: options.Token = None,
    force: options.Force = False,
    dry_run: options.DryRun = False,
    as_json: options.AsJson = False,
) -> None:
    """Upload datasets to a remote.

    With filters, it uploads the datasets of the chosen variants that are in the Minari root. Each
    dataset gets a card. Its digests are checked first. After the upload, it is compared with the remote's
    files. A dataset that the remote has already is left alone, so an interrupted push can be continued.

    Examples: `imujoco push imujoco/hopper-massdec_25_leggeom-v0 --remote hf://user`,
    `imujoco push --robot hopper --remote gcp://bucket`,
    `imujoco push --all --with-base --with-collections --dry-run`
    """
    from imujoco_minari.remotes import collections_of, plan_push, push_all
    from imujoco_minari.remotes.stores import parse_address

    chosen = choice.datasets()
    if with_collections:
        chosen += collections_of(chosen)
    if dry_run:
        # A dry run needs no remote, but one that is given must be valid.
        if remote is not None:
            parse_address(remote)
        planned = list(plan_push(chosen))
        size = filesize.decimal(sum(each.bytes for each in planned))
        say(f"{counted(len(planned), 'dataset')}: {size}")
        gather(
            planned,
            lambda each: ("would push", f"{each.dataset_id}: {filesize.decimal(each.bytes)}"),
            as_json=as_json,
        )
        return
    address = _address(remote)
    outcomes = push_all(chosen, address, token=token, force=force)
    shown = advancing(outcomes, f"pushing to {address}", len(chosen))
    gather(shown, _describe_push, as_json=as_json)


@app.command("pull")
@spread
def pull_datasets(
    remote: options.Remote = None,
    *,
    choice: DatasetChoice,
    token: options.Token = None,
    force: options.Force = False,
    as_json: options.AsJson = False,
) -> None:
    """Download datasets from a remote.

    Every digest is checked before a dataset is visible. With filters, it downloads the datasets of the
    chosen variants of the catalogue. A dataset that is in the Minari root already is left alone. A
    collection brings the datasets that it was combined from. --force does not replace those.

    Examples: `imujoco pull imujoco/hopper-massdec_25_leggeom-v0 --remote hf://user`,
    `imujoco pull --robot hopper --category mass --remote gcp://bucket`
    """
    from imujoco_minari.remotes import pull_all

    chosen = choice.datasets(published=False)
    address = _address(remote)
    outcomes = pull_all(chosen, address, token=token, force=force)
    shown = advancing(outcomes, f"pulling from {address}", len(chosen))
    gather(shown, _describe_pull, as_json=as_json)


def _describe_push(pushed: Pushed) -> tuple[str, ...]:
    if not pushed.uploaded:
        return "left alone", f"{pushed.dataset_id}: {pushed.remote} has the same already"
    checked = f"{filesize.decimal(pushed.bytes)}, read back and equal, in {pushed.seconds:.1f} s"
    return "pushed", f"{pushed.dataset_id} to {pushed.remote}: {checked}"


def _describe_pull(pulled: Pulled) -> tuple[str, ...]:
    if not pulled.downloaded:
        return "left alone", f"{pulled.dataset_id}: it is here already, at {pulled.path}"
    lines = [f"{pulled.dataset_id}, checked, in {pulled.seconds:.1f} s", f"  at {pulled.path}"]
    if not pulled.same_simulator:
        lines.append("  made with another simulator: its replay will not be exact here")
    return "pulled", *lines


def _address(remote: str | None) -> str:
    address = remote or os.environ.get("MINARI_REMOTE")
    if not address:
        raise RemoteError("name a remote with --remote, or in MINARI_REMOTE: hf://<user> or gcp://<bucket>")
    # The bars of huggingface_hub would stand between our lines. It reads this when it is imported.
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    return address
