"""Files of other tools, changed in their structure: accepted and then given back as they were, or refused in one line."""

import contextlib
import dataclasses
import importlib
import itertools
import json
import shutil
from pathlib import Path

import gymnasium
import h5py
import hypothesis.strategies as st
import minari
import numpy as np
import pytest
from fuzzing import COUNTS, accepted, contents, fuzz

import hindrl_jax as hindrl
from hindrl_jax.demonstrations.convert import read, restore, write
from hindrl_jax.demonstrations.foreign import Interpretation

ROBOMIMIC_FILE = Path(__file__).parent.parent / "data" / "robomimic_low_dim.hdf5"
KEYS = ("objects", "goal", "delivered", "held")
SHARE = st.floats(0, 1, exclude_max=True)


def same_recording(one, other):
    """Whether demonstrations are equal, to the precision that they are learned from."""
    assert [demo.name for demo in one.demonstrations] == [demo.name for demo in other.demonstrations]
    for first, second in zip(one.demonstrations, other.demonstrations, strict=True):
        for field in ("observations", "achieved_goals", "desired_goal", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(first, field), getattr(second, field), err_msg=field)
        assert first.terminated == second.terminated


# -------------------------------------------------------------------------------------------------------------------------------- robomimic


def everything(group, prefix=""):
    """All datasets below a group, links followed, read without our code."""
    for name in group:
        item = group[name]
        if isinstance(item, h5py.Group):
            yield from everything(item, f"{prefix}{name}/")
        else:
            yield prefix + name, item[()]


@st.composite
def mutations(draw):
    mild = ["soft", "hard", "external", "rename", "attribute", "root", "text", "odd", "mask"]
    kind = draw(st.sampled_from([*mild, *mild, "dangling", "circle", "type", "shape", "value", "remove"]))
    return (
        kind,
        draw(SHARE),
        draw(SHARE),
        draw(st.sampled_from([np.nan, np.inf, 0.0, -7.0, 1.0])),
        draw(st.sampled_from(["f2", "f4", "f8", "i1", "u8", "S3", "?"])),
    )


def mutate(path, mutation):
    """Changes one thing in a file; what cannot be changed stays."""
    kind, where, which, value, dtype = mutation
    with h5py.File(path, "r+") as file:
        names = [name for name, _ in everything(file)]
        name, other = names[int(where * len(names))], names[int(which * len(names))]
        array = file[name][()]
        group = name.rpartition("/")[0]
        if kind in ("soft", "hard", "external", "dangling", "circle", "type", "shape", "value", "remove"):
            if kind == "external":
                with h5py.File(path.with_name("beside.hdf5"), "a") as beside:
                    beside.require_group(group or "/")
                    if name not in beside:
                        beside[name] = array
            same = next((known for known in names if known != name and np.array_equal(file[known][()], array)), other)
            target = file[same]
            del file[name]
            if kind == "soft":
                file[name] = h5py.SoftLink(f"/{same}")
            elif kind == "hard" and same != name:
                file[name] = target
            elif kind == "external":
                file[name] = h5py.ExternalLink("beside.hdf5", f"/{name}")
            elif kind == "dangling":
                file[name] = h5py.SoftLink("/nowhere")
            elif kind == "circle":
                file[name] = h5py.SoftLink("/data")
            elif kind == "type":
                file[name] = array.astype(dtype) if array.dtype.kind in "fiub" else array
            elif kind == "shape":
                file[name] = array[..., None] if which < 0.4 else array[:-1] if which < 0.7 and array.ndim else array.reshape(-1)
            elif kind == "value":
                if array.dtype.kind == "f" and array.size:
                    array.flat[int(which * array.size)] = value
                file[name] = array
        elif kind == "rename":
            demos = [demo for demo in file["data"] if isinstance(file["data"].get(demo), h5py.Group)]
            if demos:
                file["data"].move(demos[int(where * len(demos))], ["demo_7", "demo_x", "run 3", "demo_007", "ü"][int(which * 5)])
        elif kind == "attribute":
            place = [file, file["data"], *file["data"].values()][int(where * 3)]
            if isinstance(place, h5py.Group):
                place.attrs[["note", "env_args", "num_samples", "total", "model_file"][int(which * 5)]] = [
                    value,
                    "text",
                    np.arange(3),
                    b"bytes",
                    np.int8(3),
                ][int(where * 5)]
        elif kind == "root":
            file[f"root{int(which * 9)}"] = np.arange(3, dtype=np.int16)
        elif kind == "text":
            file[f"{group}/text{int(which * 9)}"] = np.array(["ein", "längeres", ""] if which < 0.5 else ["x"], object)
        elif kind == "odd":
            odd = [
                np.zeros(2, [("a", "f4"), ("b", "i2")]),
                h5py.Empty("f4"),
                np.float64(3),
                np.zeros((0, 2)),
                np.array(["ab", "c"], "S2"),
                np.zeros(2, complex),
            ]
            file[f"{group}/odd{int(which * 9)}"] = odd[int(which * len(odd))]
        elif kind == "mask":
            masks = [
                np.array([b"demo_1"]),
                np.array(["demo_1", "demo_99"], object),
                np.array([True, False]),
                np.bytes_(b"demo_1"),
                np.array([b"none"]),
            ]
            file.require_group("mask")
            if "new" not in file["mask"]:
                file["mask/new"] = masks[int(which * len(masks))]


@st.composite
def meanings(draw):
    options = dict(
        observation_keys=draw(st.sampled_from([KEYS] * 9 + [("objects", "goal"), ("obs",), ()])),
        solved=draw(st.sampled_from(["dones", "dones", "dones", "reward", "all"])),
        sparse_rewards=draw(st.booleans()),
        repeat_last_observation=draw(st.booleans()),
        filter_key=draw(st.sampled_from([None] * 6 + ["train", "new", "nothing"])),
    )
    return options | ({"cut": draw(st.booleans())} if options["solved"] != "all" else {})


@fuzz("file of robomimic", st.lists(mutations(), min_size=1, max_size=3), meanings())
def test_files_of_robomimic(drawn, options, *, tmp_path, **_):
    folder = tmp_path / "files"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    path, ours, back = (folder / name for name in ("source.hdf5", "ours.hdf5", "back.hdf5"))
    shutil.copy(ROBOMIMIC_FILE, path)
    for mutation in drawn:
        with contextlib.suppress(OSError, KeyError, ValueError, RuntimeError, TypeError, IndexError):  # what was changed before is in the way
            mutate(path, mutation)
    before = contents(folder)
    meaning = Interpretation(**options)
    recording = accepted("file of robomimic", read, str(path), meaning)
    assert contents(folder) == before
    if recording is None:
        return
    write(str(ours), recording)
    again = read(str(ours))
    same_recording(recording, again)
    lengths = {}
    with h5py.File(path) as file:
        for demo in recording.demonstrations:
            group = file[f"data/{demo.name}"]
            dones, rewards = (group[key][()].reshape(-1) if key in group else np.zeros(0) for key in ("dones", "rewards"))
            lengths[demo.name] = len(group["actions"])
            plainly = {"dones": (dones > 0).any(), "reward": (rewards > 0).any(), "all": True}[options["solved"]]
            if options["solved"] != "reward" or (rewards > 0).any():
                assert demo.terminated == plainly, demo.name
            assert all(np.isfinite(rows).all() for rows in (demo.observations, demo.actions, demo.rewards))
        kept = {demo.name for demo in recording.demonstrations}
        if kept == {name for name in file["data"] if isinstance(file["data"][name], h5py.Group)} and all(
            len(demo) == lengths[demo.name] for demo in recording.demonstrations
        ):
            restore(back, again, source="ours")
            with h5py.File(back) as restored:
                one, other = dict(everything(file)), dict(everything(restored))
                assert one.keys() == other.keys()
                for name, array in one.items():
                    np.testing.assert_array_equal(other[name], array, err_msg=name)
                assert {name: str(value) for name, value in file.attrs.items()} == {name: str(value) for name, value in restored.attrs.items()}


# --------------------------------------------------------------------------------------------------------------------------------- archives


@st.composite
def archives(draw):
    """An archive of two or three demonstrations, with some arrays missing, of other types, shapes or values."""
    lengths = draw(st.lists(st.integers(1, 4), min_size=1, max_size=3))
    total, states, width = sum(lengths), sum(lengths) + len(lengths), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    arrays = {
        "lengths": np.array(lengths, draw(st.sampled_from(["u1", "i1", "i4", "u8", "i8"]))),
        "observations": rng.uniform(-1, 1, (states, width)),
        "actions": rng.uniform(-1, 1, (total, 2)),
        "achieved_goals": rng.uniform(-1, 1, (states, 1)),
        "desired_goals": rng.uniform(-1, 1, (len(lengths), 1)),
        "rewards": rng.uniform(-1, 1, total).round(),
        "terminated": rng.uniform(size=len(lengths)) < 0.5,
        "states": rng.uniform(-1, 1, (states, 2)),
        "about": np.array(json.dumps({"env_name": "Line"})),
    }
    for _ in range(draw(st.integers(0, 2))):
        name = draw(st.sampled_from(sorted(arrays)))
        kind = draw(st.sampled_from(["remove", "type", "shape", "value", "scalar"]))
        array = arrays[name]
        if kind == "remove" and len(arrays) > 2:
            del arrays[name]
        elif kind == "type" and array.dtype.kind in "fiub":
            arrays[name] = array.astype(draw(st.sampled_from(["f2", "f4", "i8", "?", "S5", "c16", "u1"])))
        elif kind == "shape" and array.ndim:
            arrays[name] = draw(st.sampled_from([array[..., None], array[:-1], array.reshape(-1), array[None]]))
        elif kind == "value" and array.dtype.kind == "f" and array.size:
            array.flat[0] = draw(st.sampled_from([np.nan, np.inf, 1e30, -3.0]))
        elif kind == "scalar":
            arrays[name] = np.array(draw(st.sampled_from(["{", "[]", '{"names": ["a"]}', '{"format_version": 1}', "3", "[" * 5000])))
    return arrays


@fuzz("archive", archives(), st.booleans(), st.booleans())
def test_archives(arrays, sparse, all_solved, *, tmp_path, **_):
    path, ours = tmp_path / "source.npz", tmp_path / "ours.hdf5"
    ours.unlink(missing_ok=True)
    np.savez(path, **arrays)
    before = contents(tmp_path)
    recording = accepted("archive", read, str(path), Interpretation(sparse_rewards=sparse, solved="all" if all_solved else "dones"))
    assert contents(tmp_path) == before
    if recording is None:
        return
    lengths = [int(length) for length in arrays["lengths"]]
    assert [len(demo) for demo in recording.demonstrations] == lengths
    starts = np.cumsum([0, *lengths])[:-1]
    for number, demo in enumerate(recording.demonstrations):
        first = starts[number]
        np.testing.assert_array_equal(demo.observations, arrays["observations"][first + number : first + number + lengths[number] + 1])
        np.testing.assert_array_equal(demo.actions, arrays["actions"][first : first + lengths[number]])
        assert demo.terminated == (all_solved or bool(arrays.get("terminated", np.ones(9))[number]))
    write(str(ours), recording)
    same_recording(recording, read(str(ours)))


# ---------------------------------------------------------------------------------------------------------------------------------- Minari


@st.composite
def episodes(draw):
    """An episode whose infos have any shape; and the success that each of its steps has, None where nobody can say."""
    steps = draw(st.integers(1, 5))
    flags = draw(st.lists(st.booleans(), min_size=steps, max_size=steps))
    rows = {"T": flags, "T + 1": [draw(st.booleans()), *flags], "T + 2": [False, False, *flags], "none": None}[
        draw(st.sampled_from(["T", "T", "T + 1", "T + 1", "T + 2", "none"]))
    ]
    infos, said = {}, flags
    if rows is None:
        said = [False] * (steps - 1) + [True]  # the episode terminates
    else:
        if len(rows) == steps + 2:
            said = None
        array = np.array(rows).astype(draw(st.sampled_from(["?", "f4", "f8", "i8"])))
        shape = draw(st.sampled_from(["(T,)", "(T,)", "(T, 1)", "(T, 1, 1)", "(T, 2)"]))
        array = {"(T,)": array, "(T, 1)": array[:, None], "(T, 1, 1)": array[:, None, None], "(T, 2)": np.stack([array, array], axis=1)}[shape]
        said = None if shape == "(T, 2)" else said
        if array.dtype.kind == "f" and draw(st.booleans()):
            array.flat[-1], said = np.nan, None
        infos = {draw(st.sampled_from(["success", "is_success"])): array, "other": np.arange(len(rows))}
    dtype = draw(st.sampled_from(["f4", "f8", "i8"]))
    width, nan = draw(st.integers(1, 2)), draw(st.booleans()) and dtype != "i8"
    return steps, infos, said, np.dtype(dtype), width, nan, draw(st.sampled_from(["f4", "i8"]))


@fuzz("dataset of Minari", episodes(), st.booleans())
def test_datasets_of_minari(drawn, cut, *, tmp_path, monkeypatch, **_):
    steps, infos, said, dtype, width, nan, action_dtype = drawn
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    shutil.rmtree(tmp_path / "minari", ignore_errors=True)
    box = gymnasium.spaces.Box(-9, 9, (width,), dtype.type)
    rows = np.arange((steps + 1) * width).reshape(steps + 1, width).astype(dtype) / (1 if dtype.kind == "i" else 7)
    observed = {
        "observation": rows,
        "achieved_goal": rows,
        "desired_goal": np.zeros_like(rows),
        "unused": np.full_like(rows, np.nan) if nan else rows,
    }
    actions = np.arange(steps)[:, None].astype(action_dtype) % 3
    episode = importlib.import_module("minari.data_collector").EpisodeBuffer(
        observations=observed,
        actions=actions,
        rewards=np.zeros(steps),
        terminations=np.arange(steps) == steps - 1,
        truncations=np.zeros(steps, bool),
        infos=infos or None,
    )
    about = dict(algorithm_name="none", author="none", author_email="none", code_permalink="none")
    about |= dict(observation_space=gymnasium.spaces.Dict(dict.fromkeys(observed, box)))
    about |= dict(action_space=gymnasium.spaces.Box(0, 2, (1,), np.dtype(action_dtype).type))
    minari.create_dataset_from_buffers("drawn-v0", [episode], **about)
    before = contents(tmp_path / "minari")
    recording = accepted("dataset of Minari", read, "minari:drawn-v0", Interpretation(cut=cut))
    assert contents(tmp_path / "minari") == before
    goes_on = said is not None and any(said[:-1])
    assert (recording is None) == (said is None or (goes_on and not cut))
    if recording is None:
        return
    (demo,) = recording.demonstrations
    assert demo.terminated == any(said)
    assert len(demo) == (said.index(True) + 1 if any(said) else steps)
    whole = action_dtype == "i8"  # three values are the middles of thirds of the policy's range
    np.testing.assert_allclose(demo.actions[:, 0], (actions[: len(demo), 0] - 1.0) * (2 / 3 if whole else 1.0), atol=1e-6)
    (tmp_path / "ours.hdf5").unlink(missing_ok=True)
    write(str(tmp_path / "ours.hdf5"), recording)
    again = read(str(tmp_path / "ours.hdf5"))
    same_recording(recording, again)
    if len(demo) == steps:
        write("minari:back-v0", again)
        back = minari.load_dataset("back-v0")[0]
        for key, array in observed.items():
            np.testing.assert_array_equal(back.observations[key], array)
        for key, array in infos.items():
            np.testing.assert_array_equal(back.infos[key], array)


# ------------------------------------------------------------------------------------------------------------------- files that are written

NAMES = ("a.hdf5", "b [0].hdf5", "c%s.npz", "ü\\.npz", "minari:x-v0", "minari:g/x-v0", "folder.hdf5", "no/where.hdf5", "plain", "n" * 250 + ".npz")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two different recordings."""
    env, path = hindrl.make("FixedGridPickAndPlace"), tmp_path_factory.mktemp("recorded") / "demos.hdf5"
    hindrl.save_demonstrations(path, hindrl.record_demonstrations(env, 2), env=env, env_args=dataclasses.asdict(env))
    both = read(str(path))
    return [dataclasses.replace(both, demonstrations=both.demonstrations[:number]) for number in (1, 2)]


@fuzz("files that are written", st.lists(st.tuples(st.sampled_from(NAMES), st.integers(0, 1), st.booleans()), min_size=2, max_size=6))
def test_what_is_written_one_after_the_other(actions, *, request, tmp_path, monkeypatch, **_):
    """A model of what lies where: nothing is replaced unless that is asked for, and all else is read back as it was written."""
    numbered = request.getfixturevalue("recordings")
    folder = tmp_path / f"files{COUNTS['files that are written']['drawn']}"
    folder.mkdir()
    (folder / "folder.hdf5").mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    model = {}
    for name, number, overwrite in actions:
        target = name if name.startswith("minari:") else str(folder / name)
        before, free = contents(folder), overwrite or name not in model
        refusal = None
        try:
            write(target, numbered[number], overwrite=overwrite)
        except hindrl.UserError as error:
            refusal = str(error)
        assert (refusal is None) == (free and name not in ("folder.hdf5", "plain")), (name, refusal)
        if refusal is None:
            model[name] = number
        else:
            assert "\n" not in refusal
            assert contents(folder) == before
        for known, written in model.items():
            same_recording(read(known if known.startswith("minari:") else str(folder / known)), numbered[written])
    COUNTS["files that are written"]["accepted"] += 1
    names = {path.name for path in itertools.chain(folder.iterdir(), (folder / "no").glob("*"))}
    assert not any(name.endswith((".tmp", ".old")) for name in names), names
