"""Command lines, configurations, files of ours and runs: one line and exit code 2, or accepted; never a traceback, and nothing written or lost."""

import dataclasses
import json
import shlex
import shutil

import h5py
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from fuzzing import COUNTS, accepted, contents, fuzz
from tiny import CONFIG
from tiny import ENV as TINY_ENV

import hindrl_jax as hindrl
from hindrl_jax import cli
from hindrl_jax.cli import COMMANDS, running
from hindrl_jax.config import TrainConfig
from hindrl_jax.runs.reader import load_run
from hindrl_jax.runs.spec import RunSpec, read_spec

ENV = hindrl.make("FixedGridPickAndPlace")

# ------------------------------------------------------------------------------------------------------------------------------- configs

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=4,
)


def places(tree, path=()):
    """The paths of everything in a tree of dictionaries and lists."""
    yield path
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        yield from places(value, (*path, key))


@st.composite
def configs(draw):
    """A config.json of ours with something wrong, or merely changed: a value, a name, a missing field, a cut or a changed byte."""
    env = hindrl.make(draw(st.sampled_from(["FixedGridPickAndPlace", "ParameterizedReach"])))
    data = RunSpec(env=env, config=TrainConfig(), demos="1", seeds=(0, 1)).to_json()
    for _ in range(draw(st.integers(1, 2))):
        path = draw(st.sampled_from(list(places(data))))
        if not path:
            data = draw(st.just(data) | JSON)
        else:
            *before, last = path
            holder = data
            for key in before:
                holder = holder[key]
            kind = draw(st.sampled_from(["change", "remove", "add", "misspell"]))
            if kind == "change":
                holder[last] = draw(JSON)
            elif kind == "remove":
                del holder[last]
            elif isinstance(holder, dict):
                holder[f"{last}s" if kind == "misspell" else draw(st.text(max_size=8))] = draw(JSON)
        if not isinstance(data, dict):
            break
    text = json.dumps(data).encode()
    kind = draw(st.sampled_from(["whole", "whole", "whole", "cut", "byte"]))
    if kind == "cut":
        return text[: draw(st.integers(0, len(text) - 1))]
    if kind == "byte":
        index = draw(st.integers(0, len(text) - 1))
        return text[:index] + bytes([draw(st.integers(0, 255))]) + text[index + 1 :]
    return text


@fuzz("config", configs())
def test_configs(content, *, tmp_path, **_):
    path = tmp_path / "config.json"
    path.write_bytes(content)
    spec = accepted("config", read_spec, path)
    if spec is not None:
        assert RunSpec.from_json(json.loads(json.dumps(spec.to_json())), path) == spec
    assert path.read_bytes() == content
    assert [other.name for other in tmp_path.iterdir()] == ["config.json"]


# ------------------------------------------------------------------------------------------------------------------------ demonstrations


@pytest.fixture(scope="module")
def demonstrations_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations") / "demos.hdf5"
    hindrl.save_demonstrations(path, hindrl.record_demonstrations(ENV, 2), env=ENV, env_args=dataclasses.asdict(ENV))
    return path


@st.composite
def damages(draw):
    """How a file of demonstrations is damaged: bytes of it, or things in it."""
    if draw(st.booleans()):
        return [("bytes", draw(st.floats(0, 1, exclude_max=True)), draw(st.binary(max_size=40)), draw(st.booleans()))]
    one = st.tuples(
        st.sampled_from(["remove", "reshape", "retype", "values", "attribute"]),
        st.floats(0, 1, exclude_max=True),
        st.sampled_from([np.nan, np.inf, -1e30, 0.5, 7.0]),
        st.sampled_from(["f8", "i1", "S3", "bool"]),
    )
    return draw(st.lists(one, min_size=1, max_size=3))


def damage(path, damages):
    for kind, where, value, extra in damages:
        if kind == "bytes":
            content = path.read_bytes()
            at = int(where * len(content))
            path.write_bytes(content[:at] + value + (b"" if extra else content[at + len(value) :]))
            continue
        with h5py.File(path, "r+") as file:
            names = []
            file.visit(names.append)
            name = names[int(where * len(names))]
            item = file[name]
            if kind == "attribute" and len(item.attrs):
                attribute = sorted(item.attrs)[int(where * 97) % len(item.attrs)]
                if extra == "S3":
                    del item.attrs[attribute]
                else:
                    item.attrs[attribute] = value
            elif kind == "remove":
                del file[name]
            elif isinstance(item, h5py.Dataset):
                array = item[()]
                del file[name]
                if kind == "reshape":
                    array = array[..., :-1] if extra == "f8" else array[:-1] if extra == "i1" else array[None]
                elif kind == "retype":
                    array = np.nan_to_num(array).astype(extra)
                elif array.dtype.kind in "fi":
                    array = array.astype(np.float64)
                    array.flat[int(where * array.size) : int(where * array.size) + 1] = value
                file[name] = array


@fuzz("file of ours", damages())
def test_demonstrations(damaged, *, request, tmp_path, **_):
    path = shutil.copy(request.getfixturevalue("demonstrations_file"), tmp_path / "demos.hdf5")
    try:
        damage(path, damaged)
    except (OSError, KeyError, RuntimeError, IndexError):
        return  # an earlier damage has made the next one impossible
    content = path.read_bytes()
    table = accepted("file of ours", hindrl.load_demonstrations, path, ENV)
    if table is not None:
        assert all(np.isfinite(leaf).all() for leaf in (table.observations, table.actions, table.rewards, table.desired_goals))
        assert np.abs(table.actions).max() <= 1.0 + 1e-4
    assert path.read_bytes() == content
    assert [other.name for other in tmp_path.iterdir()] == ["demos.hdf5"]


# ---------------------------------------------------------------------------------------------------------------------------------- runs


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "tiny"
    config = dataclasses.replace(CONFIG, algo="bc", steps=2)
    hindrl.save_run(path, hindrl.fit(TINY_ENV, hindrl.record_demonstrations(TINY_ENV, 1), config))
    return path


@fuzz("run", st.sampled_from(["parameters.npz", "config.json"]), st.floats(0, 1, exclude_max=True), st.binary(max_size=40), st.booleans())
def test_runs(victim, where, inserted, longer, *, request, tmp_path, **_):
    """Bytes of it are changed."""
    path = copy_of_run(request, tmp_path)
    content = (path / victim).read_bytes()
    at = int(where * len(content))
    (path / victim).write_bytes(content[:at] + inserted + (content[at:] if longer else content[at + len(inserted) :]))
    before = contents(path)
    accepted("run", load_run, path)
    assert contents(path) == before


def copy_of_run(request, tmp_path):
    path = tmp_path / "run"
    shutil.rmtree(path, ignore_errors=True)
    return shutil.copytree(request.getfixturevalue("finished_run"), path)


@st.composite
def changes(draw):
    """What one of the arrays of a run becomes."""
    kind = draw(st.sampled_from(["remove", "scalar", "shape", "type", "value", "below"]))
    return (
        kind,
        draw(st.floats(0, 1, exclude_max=True)),
        draw(st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e38])),
        draw(st.sampled_from(["S5", "U5", "?", "i4", "f2", "c8"])),
    )


@fuzz("run", st.lists(changes(), min_size=1, max_size=2))
def test_parameters(drawn, *, request, tmp_path, **_):
    """Arrays of it are changed; what is accepted plays with numbers."""
    path = copy_of_run(request, tmp_path)
    with np.load(path / "parameters.npz") as archive:
        arrays = dict(archive)
    for kind, where, value, letter in drawn:
        name = sorted(arrays)[int(where * len(arrays))]
        array = arrays.pop(name)
        if kind == "remove":
            continue
        if kind == "scalar":
            array = np.float32(value)
        elif kind == "shape":
            array = array[..., None] if where < 0.5 else array.reshape(-1)
        elif kind == "type" and array.dtype.kind in "fiu":
            array = array.astype(letter)
        elif kind == "value" and array.dtype.kind == "f":
            array = np.full_like(array, value)
        arrays[f"{name}/x" if kind == "below" else name] = array
    np.savez(path / "parameters.npz", **arrays)
    before = contents(path)
    run = accepted("run", load_run, path)
    assert contents(path) == before
    if run is not None:
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((run.policies, run.behavioural_goals)))
        assert all(len(leaf) == len(run.spec.seeds) for leaf in jax.tree.leaves(run.policies))


# ------------------------------------------------------------------------------------------------------------------------- command lines

NUMBER = st.sampled_from(["0", "1", "-1", "3", "1e9", "nan", "inf", "-inf", "0.5", "1e400", "0x10", "", "ten", "1,2", "99999999999999999999"])
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
WORD = NUMBER | TEXT | st.sampled_from(["hindrl", "tqc", "thesis", "None", "True", ".", "/", "/dev/null", "missing.hdf5", "FixedGridPickAndPlace"])
WORD |= st.sampled_from(
    ["gymnasium:odd_env:Odd-v0", "gymnasium:odd_env:OddForever-v0", "gymnasium:X", "fault=raise", "dims=2", "x" * 300, "minari:x-v0"]
)
FLAG = st.sampled_from(
    shlex.split(
        "env algo preset config resume demos seeds seed out overwrite no-overwrite steps num-envs num-objects horizon size buffer-size batch-size "
        "learning-rate gamma n-step bc-weight net-arch num-quantiles epsilon-steps epsilon-deviations eval-every checkpoint-every over episodes to "
        "directory options tasks "
        "expert host num-hosts distributed coordinator epsilon-filtering hindrl-sampling-strategy base backend num-waypoints "
        "noise make-kwargs make_kwargs vectorization n_step num-critics eval-episodes preset observation-keys solved cut filter-key restore csv"
    )
)
ARGUMENT = st.one_of(WORD, FLAG.map("--{}".format), st.tuples(FLAG, WORD).map(lambda pair: f"--{pair[0]}={pair[1]}"))
GROUPS = {name: [[]] if callable(found) else [[command] for command in found] for name, found in COMMANDS.items()}
COMMAND_WORDS = st.sampled_from([[name, *rest] for name, commands in GROUPS.items() for rest in commands])


class WouldTrain(Exception):
    """The input was accepted."""


@fuzz("command line", COMMAND_WORDS | st.lists(WORD, max_size=2), st.lists(ARGUMENT, max_size=6))
def test_command_lines(words, arguments, *, tmp_path, monkeypatch, capsys, **_):
    def would_train(*args, **kwargs):
        raise WouldTrain

    for name in ("fit", "record_demonstrations"):
        monkeypatch.setattr(running, name, would_train)
    monkeypatch.setattr("hindrl_jax.cli.demonstrations.record_demonstrations", would_train)
    monkeypatch.setattr("hindrl_jax.cli.demonstrations.record_by_hand", would_train)
    monkeypatch.setattr("hindrl_jax.reproduction.cells.train", would_train)
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    status = 0
    try:
        cli.main([*words, *arguments])
    except WouldTrain:
        COUNTS["command line"]["accepted"] += 1
        return
    except SystemExit as stop:
        status = stop.code or 0
    printed = capsys.readouterr()
    assert status in (0, 2), (words, arguments)
    COUNTS["command line"]["refused" if status else "accepted"] += 1
    if status == 2:
        *warnings, line = printed.err.splitlines()
        assert line.startswith("hindrl: "), printed.err
        assert all(warning.startswith("hindrl: warning: ") for warning in warnings), printed.err
        assert contents(tmp_path) == {}
    assert "Traceback" not in printed.err
