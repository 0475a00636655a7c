"""`phongfit predict`: a scene and a material in, errors that a fit would state out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from phongfit.commands.options import JsonFile, MaterialName, UnknownOptions
from phongfit.commands.progress import stage
from phongfit.files.inputs import sparing
from phongfit.files.materials import read_material
from phongfit.files.outputs import check_file, write_json
from phongfit.files.scenes import load_views
from phongfit.fitting.predict import Prediction, predict_errors

PREDICTION_FORMAT = "phongfit prediction"


@dataclass(frozen=True)
class Options:
    """Options of `phongfit predict`.

    Args:
        scene: A scene.json, or the folder of a data set. If it lists images, the
            prediction is for one photograph with the lights of each, else for one with
            all lights.
        material: The true one: preset:NAME, an .mtl (FILE.mtl:NAME for one of several)
            or a .json.
        noise: Standard deviation of the sensor's noise in linear light, where white
            is 1.
        json: File for the numbers, with their covariance.
    """

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    material: MaterialName
    noise: Annotated[float, arg(metavar="SD")]
    unknown: OmitArgPrefixes[UnknownOptions] = UnknownOptions()
    json: JsonFile = None


def main(options: Options) -> int:
    """Predict standard errors before taking photographs.

    Prints the standard errors that a fit would have: without clipping and rounding, no
    unbiased estimate can do better (Cramér-Rao). Compare lights, views and exposures
    with it.

    For example:
      phongfit predict out/brass --material preset:brass --noise 0.01
      phongfit predict out/brass --material preset:brass --noise 0.01 \
--unknowns diffuse specular shininess scene.lights[0].direction \
--per-image scene.lights[0].direction
    """
    out = options.json
    if out is not None:
        check_file(out)
    with sparing(out):
        material = read_material(options.material).material
        scenes, film = load_views(options.scene)
    one = scenes[0] if len(scenes) == 1 else scenes
    given = options.unknown.given()
    with stage("predicting"):
        prediction = predict_errors(one, material, options.noise, film=film, **given)
    if out is not None:
        write_json(out, _numbers(prediction, options.noise))
    print(prediction)
    if out is not None:
        print(f"\n{out}")
    return 0


def _numbers(prediction: Prediction, noise: float) -> dict:
    names = "labels values errors covariance at_bound unidentified n_samples warnings"
    numbers = {name: getattr(prediction, name) for name in names.split()}
    return {"format": PREDICTION_FORMAT, "version": 1, "noise": noise, **numbers}
