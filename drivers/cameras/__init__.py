"""Adapters of 3D cameras: what each vendor's library or file gives, as `Frame3D`. Vendor libraries are imported by `open` only.

| driver | camera | how it was tested |
|---|---|---|
| folder | any, whose software exports PLY, PCD or NPZ files | files as vendors write them |
| genicam | GigE Vision and other GenICam cameras, through Aravis or a GenTL producer | Aravis' fake GigE Vision camera, the producer viky |
| realsense | Intel RealSense D4xx | the vendor's software device, and recordings replayed |
| mech_eye, photoneo, zivid | of those vendors | conversions only; never run on hardware |
"""
