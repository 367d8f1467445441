"""How inputs are drawn and counted. A drawn input is accepted or refused in one line; everything else is a fault."""

import collections
import os

import hypothesis
import hypothesis.strategies as st
import pytest

import hindrl_jax as hindrl

AMOUNTS = {
    "config": (30, 400),
    "file of ours": (15, 250),
    "file of robomimic": (4, 350),
    "archive": (30, 250),
    "dataset of Minari": (4, 100),
    "files that are written": (1, 50),
    "run": (8, 75),  # twice
    "command line": (20, 250),
    "environment": (15, 200),
}
"""Of each kind: in `make test`, and in `make test-fuzz`, 2,000 in all."""
COUNTS: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
SETTINGS = dict(
    deadline=None,
    database=None,
    derandomize="FUZZ_SEED" not in os.environ,  # so that a failure is the same everywhere
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture, hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.data_too_large],
)


def fuzz(kind, *strategies):
    """The test twice, quick and in full. FUZZ_SEED draws others than usual."""

    def decorate(test):
        quick, full = AMOUNTS[kind]

        @pytest.mark.parametrize("amount", [quick, pytest.param(full, marks=pytest.mark.slow)])
        @pytest.mark.filterwarnings("ignore")
        def repeated(amount, request, tmp_path, monkeypatch, capsys):
            @hypothesis.settings(max_examples=amount, **SETTINGS)
            @hypothesis.given(st.tuples(*strategies))
            def once(drawn):
                COUNTS[kind]["drawn"] += 1
                test(*drawn, request=request, tmp_path=tmp_path, monkeypatch=monkeypatch, capsys=capsys)

            if "FUZZ_SEED" in os.environ:
                once = hypothesis.seed(int(os.environ["FUZZ_SEED"]))(once)
            once()

        repeated.__name__ = test.__name__
        repeated.__doc__ = test.__doc__
        return repeated

    return decorate


def accepted(kind, function, *arguments, **options):
    """What a function returns, or None where it refuses; any other exception is a fault, and so is a refusal of several lines."""
    try:
        result = function(*arguments, **options)
    except hindrl.UserError as error:
        COUNTS[kind]["refused"] += 1
        if "\n" in str(error) or not 10 < len(str(error)) < 3_000:
            raise AssertionError("this is not one line") from error
        return None
    COUNTS[kind]["accepted"] += 1
    return result


def contents(folder):
    """Every file and what is in it."""
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
