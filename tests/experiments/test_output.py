"""What experiments print."""

import io

from rich.console import Console

from experiments.output import print_warnings


def test_codes_of_warnings_are_printed():
    file = io.StringIO()
    print_warnings(Console(file=file, width=80), ["it is at its bound [at-bound]"])
    assert file.getvalue() == "  ! it is at its bound [at-bound]\n"
