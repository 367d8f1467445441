"""Training, recording and playing in memory: many seeds in one program, spread over devices; no disk, and on the screen progress alone.

Environments are asked what they can do (`hindrl_jax.base`), never of what kind they are.

    experiment      fit: the loop between the programs
    imitating       what comes before it: clones of the demonstrations, and their practice
    evaluating      evaluations along it, and what is returned in the end
    progress        the bar that a person sees
    result          what it leaves: Result, Row, SeedSummary
    selection       the policies that are kept along a run, and which of them is returned
    checks          what is refused, in a line that names the ability that is missing
    programs        the compiled programs of an experiment; of environments that are stepped in JAX
    host            the same for environments that are stepped outside JAX
    playing         episodes by an expert or by trained policies, wherever they are stepped; host_playing outside JAX
    recording       record_demonstrations, record_gymnasium
    devices         the seed axis spread over devices
"""
