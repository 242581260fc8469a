"""CoBEVGlue: connected vehicles and roadside units see together without trusting GPS."""

from cobevglue.alignment import Alignment, BEVGlue, BEVGlueConfig
from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2

__version__ = "0.1.0"
__all__ = ["SE2", "Alignment", "BEVGlue", "BEVGlueConfig", "Boxes", "__version__"]
