"""Virtual roses: flowers whose shape, arrangement and scans are known exactly.

They are an independent truth for whatever puts scanned petals together. Frames and files are those of the flower folder: mm, degrees.
"""

from sim.rose.arrangement import Rose, RosePetal, grow
from sim.rose.errors import RoseError
from sim.rose.placement import Placed, measure
from sim.rose.scanner import RangeFinder, Scan, scan
from sim.rose.specimen import write_specimen

__all__ = ["Placed", "RangeFinder", "Rose", "RoseError", "RosePetal", "Scan", "grow", "measure", "scan", "write_specimen"]
