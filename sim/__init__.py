"""Simulated instruments at the wire, and the virtual bench and petals they measure.

Nothing here is shared with the drivers: the instruments are written from the makers' protocol descriptions, so that a driver which agrees
with them agrees with the manual and not with itself. Not simulated: baud rate, parity and framing, RS-485 turnaround, USB-serial latency,
interference.
"""
