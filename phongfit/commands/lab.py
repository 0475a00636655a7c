"""`phongfit lab`: a page with sliders; see `phongfit/lab`."""

from phongfit.commands.cache import keep_compiled
from phongfit.lab.command import Options, lab, leave_work_behind


def main(options: Options) -> None:
    keep_compiled()
    lab(options)
    leave_work_behind()


main.__doc__ = lab.__doc__
