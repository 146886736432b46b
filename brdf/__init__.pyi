from .albedo import directional_albedo as directional_albedo
from .conversions import (
    exponent_from_roughness as exponent_from_roughness,
)
from .conversions import (
    exponent_from_slope as exponent_from_slope,
)
from .conversions import (
    half_from_mirror as half_from_mirror,
)
from .conversions import (
    mirror_from_half as mirror_from_half,
)
from .conversions import (
    nearest_classic as nearest_classic,
)
from .conversions import (
    nearest_normalized as nearest_normalized,
)
from .conversions import (
    roughness_from_exponent as roughness_from_exponent,
)
from .conversions import (
    slope_from_exponent as slope_from_exponent,
)
from .display import (
    displayed as displayed,
)
from .errors import InputError as InputError
from .geometry.camera import (
    OrthographicCamera as OrthographicCamera,
)
from .geometry.camera import (
    PerspectiveCamera as PerspectiveCamera,
)
from .geometry.rectangle import Rectangle as Rectangle
from .geometry.sphere import Sphere as Sphere
from .geometry.surface_points import SurfacePoints as SurfacePoints
from .geometry.triangles import Triangles as Triangles
from .geometry.triangles import load_mesh as load_mesh
from .images.reading import ImageReader as ImageReader
from .images.reading import Picture as Picture
from .images.reading import read_image as read_image
from .images.reading import read_layers as read_layers
from .images.reading import read_mask as read_mask
from .images.reading import read_picture as read_picture
from .images.writing import write_image as write_image
from .lights.area import PolygonLight as PolygonLight
from .lights.area import RectangleLight as RectangleLight
from .lights.area import SphereLight as SphereLight
from .lights.environment import ConstantEnvironment as ConstantEnvironment
from .lights.environment import EnvironmentMap as EnvironmentMap
from .lights.punctual import (
    DirectionalLight as DirectionalLight,
)
from .lights.punctual import (
    PointLight as PointLight,
)
from .lights.punctual import (
    SpotLight as SpotLight,
)
from .materials.exports import (
    export_material as export_material,
)
from .materials.exports import (
    save_export as save_export,
)
from .materials.material_file import (
    load_material as load_material,
)
from .materials.material_file import (
    load_materials as load_materials,
)
from .materials.material_file import (
    save_material as save_material,
)
from .materials.presets import PRESETS as PRESETS
from .materials.presets import preset as preset
from .measured.loading import load_measured as load_measured
from .measured.merl import merl_table as merl_table
from .measured.table import MeasuredBRDF as MeasuredBRDF
from .models import (
    MODELS as MODELS,
)
from .models import (
    BlinnPhong as BlinnPhong,
)
from .models import (
    Lambert as Lambert,
)
from .models import (
    Material as Material,
)
from .models import (
    NormalizedBlinnPhong as NormalizedBlinnPhong,
)
from .models import (
    NormalizedPhong as NormalizedPhong,
)
from .models import (
    Phong as Phong,
)
from .plausibility.report import Report as Report
from .plausibility.stability import (
    stability_map as stability_map,
)
from .plausibility.verdicts import check as check
from .precision import cast as cast
from .rendering import (
    basis_images as basis_images,
)
from .rendering import (
    relight as relight,
)
from .rendering import (
    render as render,
)
from .rendering import (
    render_lights as render_lights,
)
from .scene import Scene as Scene
from .scene import some_pixels as some_pixels
