#!/usr/bin/env bash
# Installs a wheel or an sdist into a fresh environment, and trains there for a moment, in a folder that has `envs` and `experts` of its own:
# tests/try_package.sh python3 FILE
set -euo pipefail
python=$1
package=$(realpath "$2")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
"$python" -m venv venv
venv/bin/pip install -q --disable-pip-version-check "$package"
unset PYTHONPATH
for name in envs experts; do
  mkdir "$name"
  echo 'MINE = True' >"$name/__init__.py"
done
# Everything that the package brought lies in one folder, beside its dist-info and the command.
venv/bin/python - <<'END'
from importlib.metadata import files
tops = {file.parts[0] for file in files("hindrl-jax")} - {".."}
assert {top for top in tops if not top.endswith(".dist-info")} == {"hindrl_jax"}, tops
END
venv/bin/python -c 'import envs, experts, hindrl_jax; assert envs.MINE and experts.MINE; hindrl_jax.make("FixedGridPickAndPlace")'
venv/bin/python -c 'import hindrl_jax; assert "site-packages" in hindrl_jax.__file__, hindrl_jax.__file__'
venv/bin/hindrl envs >/dev/null
tiny="--steps 260 --num-envs 2 --learning-starts 200 --eval-every 40 --eval-episodes 2 --batch-size 16 --net-arch 8 --buffer-size 2000 --updates-per-iteration 1"
venv/bin/hindrl train --env FixedGridPickAndPlace --demos 1 $tiny --out run
# The arm's model is a data file of the package: MJX and the pictures read it.
venv/bin/hindrl demos record --env FixedParameterizedReach --demos 1 --out arm.hdf5
venv/bin/python -c 'import hindrl_jax; from hindrl_jax.envs import panda; hindrl_jax.make("FixedParameterizedReach", backend="mjx"); print(panda.model().nq, "joints")'
test -s run/episode.gif
echo "$(basename "$package") works with $("$python" --version)"
