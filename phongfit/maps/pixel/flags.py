"""Flags of pixels: bits of two bytes."""

from enum import IntFlag


class Flag(IntFlag):
    """Reasons why parameters of a pixel are not identified or need care.

    - `OUTSIDE`: it sees no surface, or is masked; it was not fitted.
    - `BLACK`: all its samples are zero: nothing is identified.
    - `NOT_FINITE`: it has NaN or infinite samples, which are left out.
    - `TOO_FEW`: it has no more samples in use than unknowns: nothing is identified.
    - `NO_HIGHLIGHT`: ρ_s is 0 within its error: the exponent is not identified.
    - `DEGENERATE`: some unknowns change its samples in the same way, or not at all.
    - `AT_BOUND`: an estimate lies at its bound: an exponent is then not identified, and
        a reflectance has the error that it would have without the bound.
    - `NOT_CONVERGED`: the last step of an estimate was more than a tenth of its error:
        nothing is identified.
    - `MISFIT`: χ² is too large for the noise that was given (by 4.5 standard deviations
        of a normal distribution): the model does not describe the pixel, or the noise
        is larger. Its errors are widened by the root of χ² per degree of freedom. With
        a robust loss the median of the residuals replaces χ².
    - `IN_A_PLANE`: all lamps that light it lie in one plane with it, or they are fewer
        than three: a fitted normal is not identified, since its mirror image in that
        plane, or a steeper normal of a brighter material, gives equal samples.
    - `AMBIGUOUS`: another normal, more than 5° away, explains it as well.
    - `SEVERAL_MATERIALS`: more than one of the shared materials explains it: none has a
        probability of 95 %, and its highlight is not identified.
    """

    OUTSIDE = 1
    BLACK = 2
    NOT_FINITE = 4
    TOO_FEW = 8
    NO_HIGHLIGHT = 16
    DEGENERATE = 32
    AT_BOUND = 64
    NOT_CONVERGED = 128
    MISFIT = 256
    IN_A_PLANE = 512
    AMBIGUOUS = 1024
    SEVERAL_MATERIALS = 2048
