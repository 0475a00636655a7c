"""`phongfit lab`: a page with sliders; see `phongfit/lab`."""

from phongfit.lab.command import Options, lab, leave_work_behind


def main(options: Options) -> None:
    lab(options)
    leave_work_behind()


main.__doc__ = lab.__doc__
