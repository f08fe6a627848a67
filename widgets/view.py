"""`view(result)`: anything that a stage makes -> a panel to look at it, with the controls that teach the stage.

The one public name of `widgets`.  What it returns shows itself as the last line of a notebook's cell: live where it can
be, else as a picture, else as one line that says why.
"""

import functools
from typing import Any

from widgets.body_view import body_view
from widgets.descriptor_view import DescribedMotion, described_view, motion_view
from widgets.evaluation_view import list_view
from widgets.fields_view import fields_view
from widgets.garment_model_view import garment_model_view
from widgets.inspection_panel import inspection_result_view, inspection_view
from widgets.points_view import cloud_view, scans_view, trained_points_view
from widgets.projection_view import ProjectionComparison, comparison_view, projector_view, sequence_view
from widgets.regressor_view import regressor_view
from widgets.sdf_view import sdf_view
from widgets.subspace_view import subspace_view
from widgets.tryon_view import demo_view, result_view, tryon_view
from workbench.body.model import Body
from workbench.collisions.body_sdf import BodySDF
from workbench.collisions.diffused_body import DiffusedFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.inspection import Inspection
from workbench.collisions.projection import Projector
from workbench.collisions.regressor import Regressor
from workbench.collisions.sequences import SimulatedSequence
from workbench.collisions.subspace import Subspace
from workbench.collisions.tryon import TryOn, TryOnResult
from workbench.formats.scans import Scan
from workbench.inspector import InspectionResult
from workbench.motion import Motion
from workbench.points.clothed_points import ClothedPoints
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.trained_points import TrainedPoints
from workbench.tryon_demo import TryOnDemo


@functools.singledispatch
def view(result: Any, *others: Any, **options: Any) -> Any:
    """A `widgets.panel.Panel`: `.scene`, `.live`, `.picture(size)`, `.page(path)`, `panel["latent"] = ...`;
    a `widgets.plot.FigurePanel` where there are figures only.

    Errors: TypeError for what no stage makes.
    """
    known = ", ".join(sorted(kind.__name__ for kind in view.registry if kind is not object))
    raise TypeError(f"there is no view of a {type(result).__name__}; there are views of {known}")


view.register(Body, body_view)
view.register(DiffusedFields, fields_view)
view.register(BodySDF, sdf_view)
view.register(SimulatedSequence, sequence_view)
view.register(GarmentModel, garment_model_view)
view.register(Projector, projector_view)
view.register(ProjectionComparison, comparison_view)
view.register(Subspace, subspace_view)
view.register(TryOn, tryon_view)
view.register(TryOnResult, result_view)
view.register(TryOnDemo, demo_view)
view.register(Motion, motion_view)
view.register(DescribedMotion, described_view)
view.register(Regressor, regressor_view)
view.register(list, list_view)
view.register(Inspection, inspection_view)
view.register(InspectionResult, inspection_result_view)
view.register(ScanSequence, scans_view)
view.register(ScanFrame, cloud_view)
view.register(Scan, cloud_view)
view.register(ClothedPoints, cloud_view)
view.register(TrainedPoints, trained_points_view)
