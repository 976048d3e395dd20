from .part import Box as Box
from .part import Part as Part
from .pegs import rectangular_peg as rectangular_peg
from .pegs import rectangular_socket as rectangular_socket
