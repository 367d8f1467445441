"""Says at the end how many inputs were drawn, and what became of them."""

import fuzzing


def pytest_terminal_summary(terminalreporter):
    if fuzzing.COUNTS:
        terminalreporter.section("inputs drawn")
    for kind, counts in fuzzing.COUNTS.items():
        terminalreporter.line(f"{kind:<24}{counts['drawn']:6d} drawn {counts['accepted']:6d} accepted {counts['refused']:6d} refused")
