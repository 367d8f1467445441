"""Functions of one's own by name, as config.json and the command line have them."""

import dataclasses
import functools
import json
from pathlib import Path

import pytest
from flax import linen as nn

import hindrl_jax as hindrl
from hindrl_jax.cli.train_options import parse_train
from hindrl_jax.config import TrainConfig
from hindrl_jax.core import losses
from hindrl_jax.runs.spec import RunSpec, lost_functions
from hindrl_jax.tasks.functions import find_function, function_name

MODULE = """
from flax import linen as nn

class Tanh(nn.Module):
    out_dim: int

def calm(terms, config):
    return terms.alpha
"""


@pytest.mark.parametrize("function", [losses.actor_loss, nn.Dense, json.JSONDecoder.decode])
def test_a_function_is_found_by_its_name(function):
    assert find_function(function_name(function)) is function


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("json", "'json' is not usable: name a function as MODULE:NAME"),
        ("json:", "name a function as MODULE:NAME"),
        ("nowhere:f", "nowhere:f is not to be found in module 'nowhere' .*: start in the folder where the module is"),
        ("json:lodas", "is not to be found in module 'json'"),
        ("__main__:nobody", "is not to be found in a notebook or script .*: put it into a module of its own"),
        ("json:decoder", "json:decoder is no function but module"),
        (function_name(lambda: None), "is not to be found"),
        (function_name(functools.partial(print)), "is not to be found"),
    ],
)
def test_what_is_not_there_is_named(name, message):
    with pytest.raises(hindrl.UserError, match=message) as error:
        find_function(name)
    assert "\n" not in str(error.value)


def test_functions_that_a_run_cannot_find_again_are_named():
    def config(**functions):
        return TrainConfig(agent=dataclasses.replace(TrainConfig().agent, **functions))

    lost = config(actor_network=functools.partial(nn.Dense, use_bias=False), critic_loss=lambda terms, config: 0.0)
    assert lost_functions(lost) == ["actor_network", "critic_loss"]
    assert lost_functions(config(actor_network=nn.Dense, actor_loss=losses.actor_loss)) == []


def test_the_command_line_and_files_have_names_in_place_of_functions(tmp_path, monkeypatch):
    (tmp_path / "own_functions.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    spec, _ = parse_train(["--actor-network", "own_functions:Tanh", "--actor-loss", "own_functions:calm"])
    assert (spec.config.agent.actor_network.__name__, spec.config.agent.actor_loss.__name__) == ("Tanh", "calm")
    written = json.loads(json.dumps(spec.to_json()))
    assert written["config"]["agent"]["actor_network"] == "own_functions:Tanh"
    assert written["config"]["agent"]["critic_loss"] is None
    assert RunSpec.from_json(written, Path("config.json")) == spec
    with pytest.raises(hindrl.UserError, match=r"^--actor-loss: own_functions:clam is not to be found in module 'own_functions'"):
        parse_train(["--actor-loss", "own_functions:clam"])
