"""What the command is given: a picture with its scene, photographs of a ball, a photometric-stereo archive."""

from pathlib import Path

import brdf
from fitting.cli.first_look import is_archive, is_photograph, target_and_scene
from fitting.cli.job import Job, exposed, opaque
from fitting.cli.photograph_inputs import archive, photographs
from fitting.cli.picture_options import PictureOptions


def collect(targets: list[Path], options: PictureOptions, read: dict[Path, brdf.Picture]) -> Job:
    """What the command was given, ready to fit.

    Args:
        targets: pictures, one folder, or one archive.
        options: see there; checked.
        read: the pictures, as `read_first` read them.

    Raises:
        InputError: naming the file or option.
    """
    if is_archive(targets):
        return archive(targets[0], options)
    if is_photograph(options):
        return photographs(targets, options, read)
    target, scene = target_and_scene(targets[0], options.scene)
    mask = None if options.mask is None else brdf.read_mask(options.mask)
    loaded = brdf.Scene.load(scene, within=options.within)
    pictures = exposed([read[target]], options.exposure)
    return Job(pictures, [loaded], opaque(mask, pictures), target)
