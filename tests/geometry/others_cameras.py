"""What OpenCV and Mitsuba themselves say of cameras, for tests that have neither.

    pip install opencv-python-headless mitsuba
    python -m tests.geometry.others_cameras

writes `tests/data/others_cameras.json`; last made with OpenCV 5.0.0 and Mitsuba 3.9.1.
Pixels are in their own conventions: OpenCV counts from the centre of the first one,
Mitsuba in shares of the film from its upper left corner.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

FILE = Path(__file__).parents[1] / "data" / "others_cameras.json"
SIZE = (640, 480)
# k1, k2, p1, p2, then more; the fisheye's are k1 … k4.
LENSES = {
    "none": [],
    "barrel": [-0.3, 0.1, 0.001, -0.002],
    "pincushion": [0.2, 0.05, -0.002, 0.001, 0.02],
    "rational": [0.3, 0.1, 0.001, -0.002, 0.02, 0.1, 0.05, 0.01],
    "fisheye": [0.05, -0.01, 0.002, 0.001],
}


def of_opencv() -> dict[str, Any]:
    """Three views of twelve points through each lens."""
    import cv2  # pyright: ignore

    random = np.random.default_rng(20)
    points = random.uniform(-1, 1, (12, 3)).round(3)
    made = []
    for lens, distortion in LENSES.items():
        for view in range(3):
            focal = random.uniform(500, 900, 2)
            centre = np.array(SIZE) / 2 + random.uniform(-30, 30, 2)
            k = np.array(
                [[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]]
            )
            rotation = random.normal(size=3)
            translation = np.array([*random.uniform(-0.5, 0.5, 2), 4.0 + view])
            given = rotation, translation, k, np.array(distortion)
            if lens == "fisheye":
                pixels, _ = cv2.fisheye.projectPoints(points[None], *given)
            else:
                pixels, _ = cv2.projectPoints(points, *given)
            made.append(
                {
                    "lens": lens,
                    "matrix": k.tolist(),
                    "rotation": rotation.tolist(),
                    "R": cv2.Rodrigues(rotation)[0].tolist(),
                    "translation": translation.tolist(),
                    "distortion": distortion,
                    "pixels": pixels.reshape(-1, 2).tolist(),
                }
            )
    return {"points": points.tolist(), "views": made}


def of_mitsuba() -> dict[str, Any]:
    """Rays of a perspective sensor through points of its film."""
    import mitsuba  # pyright: ignore

    mitsuba.set_variant("scalar_rgb")
    to_world = mitsuba.ScalarTransform4f().look_at(
        origin=[1.0, 2.0, 4.0], target=[0.2, -0.1, 0.3], up=[0.1, 1.0, 0.0]
    )
    sensor = mitsuba.load_dict(
        {
            "type": "perspective",
            "fov": 40.0,
            "fov_axis": "y",
            "to_world": to_world,
            "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1]},
        }
    )
    film = [[0.5, 0.5], [0.1, 0.2], [0.9, 0.3], [0.25, 0.95]]
    rays = [sensor.sample_ray(0, 0, place, [0.5, 0.5])[0] for place in film]
    return {
        "to_world": np.array(to_world.matrix).tolist(),
        "fov_y": 40.0,
        "film": film,
        "origins": [np.array(ray.o).tolist() for ray in rays],
        "directions": [np.array(ray.d).tolist() for ray in rays],
    }


if __name__ == "__main__":
    found = {"size": SIZE, "opencv": of_opencv(), "mitsuba": of_mitsuba()}
    FILE.write_text(json.dumps(found) + "\n")
