"""A simulated UR controller: RTDE v2, dashboard, script ports and primary interface, for the real `ur_rtde` clients.

Not modelled: PolyScope X, URCaps, URScript in general (only the control script of ur_rtde, recognised by its name, and
foreign programs that do nothing), Cartesian motions, forces, digital and analog signals, blending, joint speed limits.
"""
