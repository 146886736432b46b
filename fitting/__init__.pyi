from . import functional as functional
from .front_door import fit as fit
from .implicit import Sensitivity as Sensitivity
from .implicit import sensitivity as sensitivity
from .joint import fit_jointly as fit_jointly
from .many import ManyFits as ManyFits
from .many import fit_many as fit_many
from .maps.map_fit import fit_maps as fit_maps
from .maps.map_result import Maps as Maps
from .maps.map_result import load_maps as load_maps
from .measured_fit import BrdfFitResult as BrdfFitResult
from .measured_fit import fit_brdf as fit_brdf
from .relighting import LightFit as LightFit
from .relighting import fit_lights as fit_lights
from .relighting import fit_lights_and_material as fit_lights_and_material
from .report import FitResult as FitResult
from .report.material_plots import overview as overview
from .report.material_plots import plot_albedo as plot_albedo
from .report.material_plots import plot_lobe as plot_lobe
from .report.material_plots import plot_reciprocity as plot_reciprocity
from .report.material_plots import plot_stability as plot_stability
from .report.saving import load_result as load_result
from .result import Parameter as Parameter
from .speed_accuracy import Tradeoff as Tradeoff
from .speed_accuracy import tradeoff as tradeoff

__version__: str
