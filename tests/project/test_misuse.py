"""What people get wrong, as they would write it, and the one line that they are told: what, what came, the remedy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_ball import BALL, CAMERA, SIZE, SUN, ball_scene, pictured

import brdf
import fitting

MATERIAL = brdf.BlinnPhong(k_d=[0.5, 0.4, 0.3], k_s=0.4, n=30)
SCENE = ball_scene(ambient=None)

MISUSES = {
    # rendering
    "brdf.render(scene, material)": r"material: must be a Material, got Scene\. Write brdf\.render\(material, scene\)",
    "brdf.render(material, [scene])": r"scene: must be a Scene, got list\. Write brdf\.render",
    "brdf.render(material, 'scene.toml')": r"scene: must be a Scene, got str\.",
    "brdf.render(brdf.Phong, scene)": r"material: must be a Material, got the class Phong\.",
    "brdf.render('gold', scene)": r"material: must be a Material, got str\.",
    "brdf.render(stack, scene)": r"material: is a stack of 2 materials\. Write jax\.vmap\(lambda material:",
    "brdf.check(stack)": r"material: is a stack of 2 materials\. Give one: jax\.tree\.map",
    "brdf.export_material(stack, 'three')": r"material: is a stack of 2 materials\. Give one",
    "brdf.nearest_classic(stack)": r"material: is a stack of 2 materials\. Give one",
    "brdf.save_material(stack, 'stack.mtl')": r"material: is a stack of 2 materials\. Give one",
    "brdf.render(material, scene, precision='double')": r"precision: is unknown, got 'double'\. Use float32 or float64",
    "brdf.render(brdf.Lambert(k_d=[0.5, 0.5]), scene)": r"material: has 2 channels, the light has 3\. Give both",
    "brdf.render_lights(scene, material)": r"material: must be a Material, got Scene\.",
    "brdf.relight(target, [1.0])": r"images: must be of shape \(L, H, W, C\), got .* Give what brdf\.render_lights",
    "brdf.basis_images('blinn-phong', scene)": r"model: must be the class of a material, got blinn-phong\. Write",
    "brdf.basis_images(material, scene)": r"model: must be the class of a material, got BlinnPhong\.",
    "brdf.cast(material, 'double')": r"precision: is unknown, got 'double'\.",
    "brdf.directional_albedo('gold', 0.5)": r"material: must be a Material, got str\.",
    "brdf.nearest_normalized('gold')": r"material: must be a Material, got str\.",
    "brdf.nearest_classic(brdf.Phong)": r"material: must be a Material, got the class Phong\.",
    # scenes
    "brdf.Scene(camera, brdf.Sphere([0, 0, 0], 1))": r"shapes: must be a list, got Sphere\. Write shapes=\[\.\.\.\]",
    "brdf.Scene(camera, [ball], lights=sun)": r"lights: must be a list, got DirectionalLight\. Write lights=\[",
    "brdf.Scene([ball], camera)": r"shapes: must be a list, got OrthographicCamera\.",
    "brdf.Scene(camera, [sun])": r"shapes\[0\]: must be a Shape, got DirectionalLight\. Write Scene\(camera",
    "brdf.Scene(camera, [ball], lights=[ball])": r"lights\[0\]: must be a Light, got Sphere\.",
    "brdf.Scene(brdf.OrthographicCamera, [ball])": r"camera: must be a Camera, got the class OrthographicCamera\.",
    "brdf.Scene('scene.toml')": r"camera: must be a Camera, got str\.",
    "brdf.Scene(shapes=[ball])": r"scene: must have a camera or surface points",
    "brdf.Scene(points=np.zeros((3, 3, 3)))": r"points: must be a SurfacePoints.*from_normals",
    "brdf.Scene(camera, [ball], ambient='grey')": r"intensity: must be a number per channel, got 'grey'\.",
    "brdf.Scene(camera, [ball], lights=[sun], visibility=mask)": r"visibility: must be a list, got ndarray\.",
    "brdf.Scene.load({'camera': 1})": r"path: must be text, got dict\.",
    "brdf.DirectionalLight([1, 0], 1)": r"direction: must be three numbers, got \[1, 0\]\. Give \[x, y, z\]",
    "brdf.DirectionalLight([0, 0, 1])": r"DirectionalLight: missing .*'intensity'\. Write DirectionalLight\(direction=",
    "brdf.DirectionalLight([0, 0, 1], colour=1)": r"DirectionalLight: .*(colour|intensity).*Write",
    "brdf.PointLight([0, 0, 1], -1)": r"intensity: must be at least 0, got -1",
    "brdf.Sphere()": r"Sphere: missing a required argument: 'center'\. Write Sphere\(center=\.\.\., radius=\.\.\.\)",
    "brdf.Sphere([0, 0, 0], 0)": r"radius: must be greater than 0, got 0\.",
    "brdf.OrthographicCamera([0, 0, 4], [0, 0, 0])": r"OrthographicCamera: too many positional .*position=\.\.\.",
    "brdf.Triangles('mesh.obj')": r"mesh: must be a Mesh, got str\. Write Triangles\(brdf\.load_mesh",
    "brdf.load_mesh(3)": r"path: must be text, got int\.",
    "brdf.EnvironmentMap('sky.exr')": r"pixels: must be numbers, got 'sky\.exr'\.",
    "brdf.some_pixels(scene, mask)": r"pixel: must be whole numbers .* Of a mask, give np\.flatnonzero\(mask\)",
    "brdf.some_pixels(scene, np.array([10**6]))": r"pixel: must be whole numbers from 0 to 2303",
    "brdf.Scene(scene.camera, shapes=[None])": r"shapes\[0\]: must be a Shape, got NoneType\.",
    # materials
    "brdf.BlinnPhong(0.3, 0.5, 50)": r"BlinnPhong: too many positional arguments\. Write BlinnPhong\(k_d=\.\.\., k_s=",
    "brdf.BlinnPhong(k_d=0.3, n=4)": r"BlinnPhong: missing a required argument: 'k_s'\.",
    "brdf.BlinnPhong(k_d=0.3, k_s=0.1, n=50, gloss=1)": r"BlinnPhong: got an unexpected keyword argument 'gloss'\.",
    "brdf.BlinnPhong(k_d=0.3, k_s=0.1, n=[1, 2, 3])": r"n: must be one number, got shape \(3,\)\. All channels share",
    "brdf.Phong(k_d='red', k_s=0.1, n=2)": r"k_d: must be numbers, got 'red'\.",
    "brdf.MODELS['phong'](0.3)": r"Phong: too many positional arguments\.",
    "brdf.preset('unobtainium')": r"preset: is unknown, got 'unobtainium'\. Use one of emerald",
    "brdf.check(brdf.Phong)": r"brdf: must be a material or a function, got the class Phong\.",
    "brdf.check('m.json')": r"brdf: must be a material or a function, got str\.",
    "brdf.export_material(scene, 'gltf')": r"material: must be a Material, got Scene\.",
    "brdf.export_material(material, 'unity')": r"to: is unknown, got 'unity'\. Use one of json",
    # files
    "brdf.read_image(target)": r"path: must be text, got ndarray\. Give the path of a file",
    "brdf.write_image(target, 'a.exr')": r"path: must be text, got ndarray\.",
    "brdf.save_material('a.json', material)": r"material: must be a Material, got str\. Write brdf\.save",
    "brdf.save_export('a.gltf', material)": r"path: must be text, got BlinnPhong\.",
    "brdf.load_material(material)": r"path: must be text, got BlinnPhong\.",
    "fitting.load_result(material)": r"path: must be text, got BlinnPhong\.",
    # fitting
    "fitting.fit(scene, target)": r"scene: must be a brdf\.Scene, got ndarray\.",
    "fitting.fit(target, material)": r"scene: must be a brdf\.Scene, got BlinnPhong\.",
    "fitting.fit('target.exr', scene)": r"target\.exr: there is no such file or folder\.",
    "fitting.fit(np.full_like(target, np.nan), scene)": r"target: has no finite value on the object\.",
    "fitting.fit(np.ma.masked_greater(target, -1), scene)": r"target: is a masked array.*Give its data, and mask=",
    "fitting.fit(target[..., :1], scene)": r"target: has 1 channels, the scene's light 3\. .*light of one serves every",
    "fitting.fit((255 * target).astype(np.int64), scene)": r"target: must hold floating-point .* got int64",
    "fitting.fit(target[:10], scene)": r"target: is 48 x 10, the scene's camera 48 x 48\.",
    "fitting.fit([target, target], [scene])": r"scene: has 1 entries for 2 pictures\.",
    "fitting.fit(target, scene, model=material)": r"model: is unknown, got BlinnPhong, no name\. Use auto or one of",
    "fitting.fit(target, scene, model=scene)": r"model: is unknown, got Scene, no name\. Use auto or one of",
    "fitting.fit(target, scene, model='ward')": r"model: is unknown, got 'ward'\.",
    "fitting.fit(target, scene, loss='l2')": r"loss: is unknown, got 'l2'\.",
    "fitting.fit(target, scene, n_range=5)": r"n_range: must be 0 < lower < upper, got 5\.",
    "fitting.fit(target, scene, mask='mask.png')": r"mask\.png: there is no such file or folder\.",
    "fitting.fit(target, scene, noise=0.1)": r"noise: must be two numbers, got 0\.1\.",
    "fitting.fit(target, scene, accuracy=5)": r"accuracy: must be below 1, an error of all, got 5\.",
    "fitting.fit(target, scene, accuracy='high')": r"accuracy: must be a number, got 'high'\.",
    "jax.grad(lambda t: fitting.fit(t, scene).material.n)(traced)": r"fit: cannot run inside jax\.grad.*sensitivity",
    "jax.vmap(lambda t: fitting.fit(t, scene).material.n)(traced[None])": r"fit: cannot run inside .*fit_many",
    "jax.jit(lambda s: fitting.fit(target, s).material.n)(brdf.cast(scene, None))": r"fit: .*fitting\.functional",
    "fitting.fit_jointly(target, scene, material, lambda m, s: (m.gloss,))": r"free: gives no tuple of leaves .*gloss",
    "fitting.fit_jointly(target, scene, 'ward', lambda m, s: (m.k_d,))": r"model: is unknown, got 'ward'\.",
    "fitting.fit_jointly(target, scene, lambda m, s: (m.n,), material)": r"(material|model|free): .*got ",
    "fitting.fit_jointly(target, scene, material, 3)": r"free: must be a function or names, got int\. Write lambda",
    "fitting.fit(target, scene, rounding='up')": r"rounding: must be 0 or more .*got 'up'",
    "fitting.functional.fit(target, scene, 'phong')": r"model: must be the class of a material, got phong\.",
    "fitting.functional.fit(target[:10], scene)": r"target: must be of shape \(48, 48, 3\), got \(10, 48, 3\)\.",
    "fitting.functional.fit(target[..., :2], scene)": r"target: must be of shape \(48, 48, 3\), got \(48, 48, 2\)\.",
    "fitting.functional.fit(target.astype('uint8'), scene)": r"target: must hold linear values, got codes of type",
    "fitting.functional.fit(target, scene, n_range=(5, 2))": r"n_range: must be 0 < lower < upper, got \(5, 2\)\.",
    "fitting.functional.fit(target, scene, weight=mask[:5])": r"weight: must be of shape \(48, 48\) and at least 0",
    "fitting.functional.fit(target, scene, weight=-1.0 * mask)": r"weight: must be of shape \(48, 48\) and at least 0",
    "fitting.fit_many('target.exr', scene)": r"pictures: must be an array \(N, H, W, C\) or a list, got str\.",
    "fitting.fit_many(target, scene)": r"pictures: must be .* or a list, got ndarray \(48, 48, 3\)\. Stack them",
    "fitting.fit([target, target[:10]], scene)": r"target\[1\]: is 48 x 10, the scene's camera 48 x 48\.",
    "fitting.fit_many([target, target[:10]], scene)": r"pictures\[1\]: is 48 x 10, the scene's camera 48 x 48\.",
    "fitting.fit_many([target, target], [scene])": r"scenes: has 1 entries for 2 pictures\.",
    "fitting.fit_maps([target] * 6, np.eye(3)[[2] * 6], 'fit', flip_y=True)": r"flip_y: turns normals that are given",
    "fitting.fit_maps([target] * 3, np.eye(3) + [0, 0, 1], to_view=[0, 0, -1])": r"to_view: is 90 degrees or more",
    "fitting.fit_maps([(255 * target).astype('uint8')] * 3, np.eye(3), -scene.surface_points().normal)": (
        r"normals: all point away from the camera\. Give both in one frame"
    ),
    "fitting.fit_lights(target, dark, material)": r"scene: has no lights\. Add a \[\[lights\]\] table, or \[ambient\]",
    "fitting.fit(target, scene, rounding='floor')": r"rounding: is floor, but the values stand on no levels of a file",
    "fitting.sensitivity(fitted(), 'light')": r"by: must be a function, got 'light'\. Write lambda scenes",
    "fitting.sensitivity(fitted(), lambda s: (2 * s[0].lights[0].direction,))": r"by: gives what is no number of",
    "fitting.sensitivity(fitted(), lambda s: (s[3].lights[0].direction,))": r"by: gives no tuple of leaves .* range",
    "fitting.sensitivity(fitted(), lambda s: (s[0].lights[0].pos,))": r"by: gives no tuple of leaves .*'pos'",
    "fitting.sensitivity(material, lambda s: (s[0].ambient,))": r"result: must be a FitResult, got BlinnPhong\.",
    "fitting.next_light(material)": r"result: must be of fitting\.fit or fit_maps, got BlinnPhong\.",
    "fitting.next_light(fitted(), 'up', of='k_d')": r"candidates: must hold lights or directions .* got 'u'\.",
    "fitting.next_light(fitted(), [brdf.DirectionalLight([0, 0, 1], [1, 1])], of='k_d')": r"candidates: have 2",
    "fitting.fit_lights(target, material, scene)": r"scene: must be a brdf\.Scene, got BlinnPhong\.",
    "fitting.fit_lights(target, scene, brdf.Phong)": r"material: must be a Material, got the class Phong\.",
    "fitting.fit_lights(target[..., :1], brdf.Scene(scene.camera, scene.shapes, ambient=1.0), material)": (
        r"material: has 3 channels, the picture 1\."
    ),
    "fitting.fit_lights('target.exr', scene, material)": r"target\.exr: there is no such file or folder\.",
    "fitting.fit_lights(target, scene, material, mask=np.ones((3, 3)))": r"mask: is of shape \(3, 3\), the target",
    "fitting.fit_brdf('gold.binary')": r"table: must be a brdf\.MeasuredBRDF, got str\. Use brdf\.load_measured",
    "fitting.tradeoff(scene, target)": r"scene: must be a brdf\.Scene, got ndarray\.",
}


@pytest.mark.parametrize("written", MISUSES)
def test_a_misuse_is_one_line_that_names_the_remedy(written, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    target = np.linspace(0.1, 0.9, SIZE * SIZE * 3, dtype=np.float32).reshape(SIZE, SIZE, 3)
    names = {
        **{"brdf": brdf, "fitting": fitting, "jax": jax, "np": np, "scene": SCENE, "material": MATERIAL},
        **{"camera": CAMERA, "ball": BALL, "sun": SUN, "target": target, "traced": jnp.asarray(target)},
        "mask": np.ones((SIZE, SIZE), bool),
        "dark": brdf.Scene(CAMERA, [BALL]),
        "fitted": lambda: fitting.fit(target, SCENE, model="lambert"),
        "stack": jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), MATERIAL),
    }
    with pytest.raises(brdf.InputError, match=f"^{MISUSES[written]}") as told:
        eval(written, names)
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("model", ["Blinn-Phong", "BlinnPhong", "blinn_phong", brdf.BlinnPhong])
def test_a_model_may_be_named_as_people_do(model):
    target = pictured(MATERIAL, SCENE)
    assert fitting.fit(target, SCENE, model=model).material.name == "blinn-phong"


def test_what_is_shown_of_a_scene_can_be_read():
    assert repr(SCENE) == (
        "Scene(\n"
        "    camera=OrthographicCamera(position=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0], resolution=[48, 48], "
        "width=2.2),\n"
        "    shapes=[Sphere(center=[0, 0, 0], radius=1)],\n"
        "    lights=[DirectionalLight(direction=[0.5, 0.6, 0.7], intensity=[1, 0.8, 0.6])],\n"
        ")"
    )
    many = brdf.Scene(CAMERA, [BALL], lights=[SUN] * 20)
    assert "... 12 more]" in repr(many)
    sky = brdf.EnvironmentMap(np.linspace(0, 1, 96).reshape(8, 4, 3), samples=4)
    assert repr(sky).startswith("EnvironmentMap(pixels=<8 x 4 x 3 float64>, radiance=[")
    assert repr(sky).endswith("], samples=4)")


def test_the_version_is_that_of_the_package():
    assert brdf.__version__ == fitting.__version__
    assert brdf.__version__[0].isdigit()


def test_float64_stays_float64_outside_of_the_switch():
    assert brdf.cast(MATERIAL, "float64").k_d.dtype == np.float64
    assert brdf.cast(MATERIAL, "float32").k_d.dtype == np.float32
