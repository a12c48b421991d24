"""A collection holds its sources' episodes as they were, copied or linked."""

from __future__ import annotations

import json
import shutil

import gymnasium
import h5py
import minari
import numpy as np
import pytest

from imujoco_minari.cli.app import run
from imujoco_minari.errors import DatasetError, DatasetExistsError, DatasetNotFoundError
from imujoco_minari.publishing import combiner
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.publisher import publish
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.verification import verify
from imujoco_minari.verification.findings import Finding

VARIANTS = ("hopper-base", "hopper-massdec_25_leggeom", "hopper-frictiondec_50_feet")
IDS = [f"imujoco/{variant}-random-v0" for variant in VARIANTS]
NEW = "imujoco/hopper-mine-v0"
EPISODES = 4

pytestmark = pytest.mark.usefixtures("checked_here")


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    root = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        for seed, variant in enumerate(VARIANTS):
            publish(variant, tier="random", episodes=EPISODES, seed=seed)
    return root


@pytest.fixture
def sources(published, root):
    shutil.copytree(published, root)
    return IDS


def stored(dataset):
    """Return attributes and arrays of the episodes of a dataset or view, in its order."""
    with h5py.File(file_format.main_file(dataset.storage.data_path), "r") as file:
        groups = [file[f"episode_{index}"] for index in dataset.episode_indices]
        return [
            (
                dict(group.attrs),
                {
                    key: (array.dtype, array.shape, array[()].tobytes())
                    for key, array in file_format.arrays(group)
                },
            )
            for group in groups
        ]


def expected(datasets):
    return [
        (dict(attributes, source=dataset.id), arrays)
        for dataset in datasets
        for attributes, arrays in stored(dataset)
    ]


def without_id(episodes):
    return [({key: attrs[key] for key in sorted(attrs) if key != "id"}, arrays) for attrs, arrays in episodes]


@pytest.mark.parametrize("link", [False, True])
def test_every_attribute_seed_and_array_stays(sources, link):
    datasets = [minari.load_dataset(name) for name in sources]
    collection = combine_datasets(datasets, NEW, link=link)
    assert without_id(stored(collection)) == without_id(expected(datasets))
    assert verify(NEW) == []
    numbers = [attributes["id"] for attributes, _ in stored(collection)]
    assert numbers == list(range(EPISODES)) * 3 if link else numbers == list(range(EPISODES * 3))
    metadata = collection.storage.metadata
    assert metadata["combined_datasets"] == sources
    assert metadata["total_episodes"] == 3 * EPISODES
    assert metadata["total_steps"] == sum(dataset.total_steps for dataset in datasets)
    assert ("content_sha256" in metadata) is not link


@pytest.mark.parametrize("link", [False, True])
def test_a_view_goes_in_as_that_view(sources, link):
    first, second, _ = (minari.load_dataset(name) for name in sources)
    views = [
        first.filter_episodes(lambda episode: episode.id in (1, 3)),
        *minari.split_dataset(second, [2], 5),
    ]
    collection = combine_datasets(views, NEW, link=link)
    assert without_id(stored(collection)) == without_id(expected(views))
    assert collection.total_steps == sum(view.total_steps for view in views)
    assert verify(NEW) == []


def test_a_collection_of_collections_names_the_first_source(sources):
    combine_datasets(sources[:2], NEW)
    both = combine_datasets([NEW, sources[2]], "imujoco/hopper-more-v0")
    assert [attributes["source"] for attributes, _ in stored(both)] == [
        name for name in IDS for _ in range(EPISODES)
    ]
    assert [attributes["variant"] for attributes, _ in stored(both)] == [
        name for name in VARIANTS for _ in range(EPISODES)
    ]
    assert both.recover_environment().unwrapped.variants == VARIANTS
    assert verify("imujoco/hopper-more-v0") == []


def test_the_content_digest_depends_on_the_order_alone(sources):
    digests = [
        combine_datasets(names, f"imujoco/hopper-order-v{number}").storage.metadata["content_sha256"]
        for number, names in enumerate((sources, list(sources), sources[::-1]))
    ]
    assert digests[0] == digests[1] != digests[2]


def test_datasets_of_stock_minari_get_their_digests_and_source(sources):
    # Minari's own copy of a dataset keeps no attribute of an episode but number and steps.
    minari.combine_datasets([minari.load_dataset(sources[0])], "imujoco/stock-v0")
    path = minari.load_dataset("imujoco/stock-v0").storage.data_path
    with h5py.File(file_format.main_file(path), "r") as file:
        assert file_format.DIGEST not in file["episode_0"].attrs
    collection = combine_datasets(["imujoco/stock-v0"], "imujoco/again-v0")
    attributes, arrays = stored(collection)[-1]
    assert attributes["source"] == "imujoco/stock-v0"
    assert arrays == stored(minari.load_dataset(sources[0]))[-1][1]
    with h5py.File(file_format.main_file(collection.storage.data_path), "r") as file:
        assert file_format.content_sha256(file, len(file)) == collection.storage.metadata["content_sha256"]


def test_links_are_relative_so_that_a_root_can_move(sources, root, tmp_path, monkeypatch):
    before = stored(combine_datasets(sources, NEW, link=True))
    root.rename(tmp_path / "elsewhere")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "elsewhere"))
    assert stored(minari.load_dataset(NEW)) == before


def test_a_link_takes_no_space(sources):
    linked = combine_datasets(sources, NEW, link=True)
    copied = combine_datasets(sources, "imujoco/hopper-copied-v0")
    files = [file_format.main_file(dataset.storage.data_path) for dataset in (linked, copied)]
    sizes = [file.stat().st_size for file in files]
    assert sizes[0] < sizes[1] / 5


def test_what_is_damaged_or_missing_is_named(sources, root):
    with h5py.File(file_format.main_file(root / IDS[1] / "data"), "a") as file:
        del file["episode_2"]
    for link in (False, True):
        with pytest.raises(
            DatasetError,
            match="states 4 episodes, but its file holds 3",
        ):
            combine_datasets(sources, NEW, link=link)
    with pytest.raises(DatasetNotFoundError, match="hopper-none-v0 is not in the Minari root"):
        combine_datasets([IDS[0], "imujoco/hopper-none-v0"], NEW)
    assert not (root / NEW).exists()


def identity(dataset_id):
    return minari_root.folder_identity(minari_root.dataset_folder(dataset_id))


@pytest.mark.parametrize("link", [False, True])
def test_the_same_sources_again_change_nothing(sources, link):
    views = [minari.load_dataset(IDS[0]).filter_episodes(lambda episode: episode.id in (1, 3)), IDS[1]]
    # Minari's own copy has no digests.
    minari.combine_datasets([minari.load_dataset(IDS[0])], "imujoco/stock-v0")
    for datasets in (sources, views, *([] if link else [["imujoco/stock-v0"]])):
        combine_datasets(datasets, NEW, link=link, force=True)
        before = identity(NEW)
        assert combine_datasets(datasets, NEW, link=link).total_episodes > 0
        assert identity(NEW) == before


@pytest.mark.parametrize("link", [False, True])
def test_a_stale_collection_is_named_and_combined_anew_with_force(sources, link):
    combine_datasets(sources, NEW, link=link)
    publish(VARIANTS[1], tier="random", episodes=EPISODES, seed=77, force=True)
    # The digest of a copy does not tell the source.
    changed = f": {IDS[1]}" if link else ""
    with pytest.raises(DatasetExistsError, match=rf"stale: its sources have changed{changed}\. .*--force"):
        combine_datasets(sources, NEW, link=link)
    publish(VARIANTS[1], tier="random", episodes=EPISODES + 1, seed=77, force=True)
    with pytest.raises(DatasetExistsError, match="stale: it has 12 episodes, and its sources have 13 now"):
        combine_datasets(sources, NEW, link=link)
    assert combine_datasets(sources, NEW, link=link, force=True).total_episodes == 13
    assert combine_datasets(sources, NEW, link=link).total_episodes == 13


@pytest.mark.parametrize("linked", [[1, 2], [1], [], 3, "x", None, {}])
def test_damaged_metadata_of_a_linked_collection_are_stale(sources, root, linked):
    combine_datasets(sources[:2], NEW, link=True)
    path = root / NEW / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"linked": linked}))
    with pytest.raises(DatasetExistsError, match="stale: its sources have changed"):
        combine_datasets(sources[:2], NEW, link=True)
    assert combine_datasets(sources[:2], NEW, link=True, force=True).total_episodes == 2 * EPISODES


def test_another_dataset_with_the_id_says_how_it_differs(sources):
    combine_datasets(sources[:2], NEW)
    for datasets, options, message in (
        (sources, {}, rf"already combines other datasets: it lacks {IDS[2]}\."),
        (sources[:1], {}, rf"it also has {IDS[1]}\."),
        (sources[1:], {}, rf"it lacks {IDS[2]} and also has {IDS[0]}\."),
        (sources[1::-1], {}, "it has another order"),
        (sources[:2], {"link": True}, "copies its episodes"),
    ):
        with pytest.raises(DatasetExistsError, match=message):
            combine_datasets(datasets, NEW, **options)
    with pytest.raises(DatasetExistsError, match="is not a collection"):
        combine_datasets(sources[:1], IDS[0])
    assert minari.load_dataset(NEW).total_episodes == 2 * EPISODES
    assert combine_datasets(sources, NEW, force=True).total_episodes == 3 * EPISODES


def test_the_id_of_a_whole_set_stands_for_the_whole_set(sources, monkeypatch):
    for new, message in (
        (
            "imujoco/hopper-all-random-v0",
            "the tier random of all 37 variants of hopper, but the sources lack 35",
        ),
        ("imujoco/hopper-friction-random-v0", "all 3 variants of hopper in friction, but the sources lack 2"),
    ):
        with pytest.raises(DatasetError, match=f"{message} .*have .*hopper-base.* too: choose another id"):
            combine_datasets(sources, new)
    friction = [f"hopper-friction{change}_feet" for change in ("dec_50", "dec_25", "inc_50")]
    for name in friction[1:]:
        publish(name, tier="random", episodes=1)
    ids = [f"imujoco/{name}-random-v0" for name in friction]
    with pytest.raises(
        DatasetError, match=r"stands for the tier expert .*, but the sources have the tiers random"
    ):
        combine_datasets(ids, "imujoco/hopper-friction-v0")
    whole = combine_datasets(ids, "imujoco/hopper-friction-random-v0")
    registered = gymnasium.make("imujoco/hopper-friction-v0")
    assert whole.recover_environment().unwrapped.variants == registered.unwrapped.variants


def test_nothing_and_two_robots_are_refused(sources, monkeypatch):
    monkeypatch.setattr("imujoco_minari.publishing.publisher.reference_scores", lambda variant: {})
    publish("halfcheetah-base", tier="random", episodes=1)
    with pytest.raises(DatasetError, match="no dataset was given"):
        combine_datasets([], NEW)
    with pytest.raises(DatasetError, match="a collection holds one robot"):
        combine_datasets([IDS[0], "imujoco/halfcheetah-base-random-v0"], NEW)
    empty = minari.load_dataset(IDS[0]).filter_episodes(lambda episode: False)
    with pytest.raises(DatasetError, match="have no episodes"):
        combine_datasets([empty], NEW)


def test_an_environment_of_all_its_variants_resets_to_each(sources):
    env = combine_datasets(sources, NEW).recover_environment()
    observations = [env.reset(seed=1, options={"variant": variant})[0] for variant in VARIANTS]
    assert all(np.array_equal(observations[0], observation) for observation in observations)
    with pytest.raises(ValueError, match="is not in this collection"):
        env.reset(seed=1, options={"variant": "hopper-massinc_200_footgeom"})


def test_a_file_that_has_changed_is_first_read_by_another_process(sources, monkeypatch):
    asked = []

    def killed(data):
        asked.append(data)
        return Finding("main_data.hdf5", "is damaged so that reading it kills the process (SIGSEGV)")

    with monkeypatch.context() as patch:
        patch.setattr(combiner, "survives", killed)
        combine_datasets(sources, NEW)
        assert asked == []
        file = file_format.main_file(minari_root.dataset_folder(sources[1]) / "data")
        with file.open("ab") as stream:
            stream.write(b"0")
        with pytest.raises(DatasetError, match=rf"{sources[1]} cannot be combined: .*SIGSEGV"):
            combine_datasets(sources, "imujoco/changed-v0")
        assert asked == [file.parent]
    assert "imujoco/changed-v0" not in minari.list_local_datasets()
    # Whatever has changed, a file that can be read is combined as it is.
    assert combine_datasets(sources, "imujoco/changed-v0").total_episodes == 3 * EPISODES


def test_a_linked_collection_does_not_replace_what_it_links_to(sources, capsys):
    before = stored(minari.load_dataset(IDS[0]))
    first, second = "imujoco/hopper-first-v0", "imujoco/hopper-second-v0"
    combine_datasets(sources[:2], first, link=True)
    combine_datasets([first], second, link=True)
    for names in (sources[:2], [first], [IDS[2], second]):
        assert run(["combine", *names, "--id", IDS[0], "--link", "--force"]) == 1
        assert f"error: {IDS[0]} was not replaced: the new dataset links to it" in capsys.readouterr().err
        assert stored(minari.load_dataset(IDS[0])) == before
    assert verify(IDS[0]) == verify(second) == []


def test_a_copy_may_replace_one_of_its_sources(sources):
    before = stored(minari.load_dataset(IDS[0]))
    with pytest.raises(DatasetError, match="is the id of a variant's dataset, but the sources have episodes"):
        combine_datasets(sources[:2], IDS[0], force=True)
    assert stored(minari.load_dataset(IDS[0])) == before
    combined = combine_datasets([IDS[0], IDS[0]], IDS[0], force=True)
    assert without_id(stored(combined))[:EPISODES] == [
        (dict(attributes, source=IDS[0]), arrays) for attributes, arrays in without_id(before)
    ]
    assert combined.total_episodes == 2 * EPISODES
    findings = verify(IDS[0])
    assert findings == []
    assert findings.exceptions == (
        f"{EPISODES} of its episodes are equal to earlier ones",
        "it is a collection under the id of a variant",
    )


def test_verify_finds_a_linked_source_that_was_replaced(monkeypatch):
    monkeypatch.setattr("imujoco_minari.publishing.publisher.reference_scores", lambda variant: {})
    # All of its episodes have 1000 steps, so that the totals stay.
    publish("halfcheetah-base", tier="random", episodes=1)
    combine_datasets(["imujoco/halfcheetah-base-random-v0"], NEW, link=True)
    combine_datasets([NEW], "imujoco/further-v0", link=True)
    assert verify(NEW, replay=False) == verify("imujoco/further-v0", replay=False) == []
    publish("halfcheetah-base", tier="random", episodes=1, seed=1, force=True)
    for name in (NEW, "imujoco/further-v0"):
        assert "was replaced since the collection linked to it" in str(verify(name)[0])
