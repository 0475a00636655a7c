"""Are the residuals noise? If not, the model does not describe the image."""

import numpy as np


def neighbour_correlation(residuals: list[np.ndarray], used: list[np.ndarray]) -> float:
    """Correlation of the residuals of adjacent pixels: 0 for independent noise.

    **Arguments:**

    - `residuals`: images (H, W, 3), model − image.
    - `used`: (H, W, 3) each, true where a sample takes part.

    **Returns:** a number in [−1, 1]; 0 where it is no more than chance.
    """
    products = pairs = squares = count = 0.0
    for residual, mask in zip(residuals, used, strict=True):
        value = np.where(mask, residual, 0).astype(float)
        for here, there in (
            ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
            ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
        ):
            products += float(np.sum(value[here] * value[there]))
            pairs += float(np.sum(mask[here] & mask[there]))
        squares += float(np.sum(value**2))
        count += float(np.sum(mask))
    if pairs == 0 or squares == 0:
        return 0.0
    correlation = float(np.clip(products / pairs * count / squares, -1, 1))
    return correlation if abs(correlation) > 5 / np.sqrt(pairs) else 0.0


def variance_inflation(correlation: float) -> float:
    r"""Factor on variances if neighbours correlate: $(\frac{1+c}{1-c})^2$, at least 1.

    Pixels that repeat one another are fewer independent ones. The factor is that of a
    first-order autoregressive process along each image axis.

    ??? cite "Source"
        Bayley and Hammersley, *The effective number of independent observations in an
        autocorrelated time series*, J. R. Stat. Soc. Suppl. 8(2), 1946.
    """
    c = min(max(correlation, 0.0), 0.99)
    return ((1 + c) / (1 - c)) ** 2
