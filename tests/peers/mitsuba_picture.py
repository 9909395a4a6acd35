"""Render a Mitsuba XML to a linear PNG of 16 bits, on one thread, so often; prints the seconds of
each render after a first one, which compiles.

    python mitsuba_picture.py scene.xml out.png RUNS
"""
import sys
import time

import drjit as dr
import mitsuba as mi

mi.set_variant('llvm_ad_rgb')
dr.set_thread_count(1)
xml, png, runs = sys.argv[1], sys.argv[2], int(sys.argv[3])
scene = mi.load_file(xml)
for run in range(runs + 1):
    start = time.perf_counter()
    image = mi.render(scene, seed=run)
    dr.eval(image)
    dr.sync_thread()
    if run:
        print(f'render {time.perf_counter() - start:.6f}')
bitmap = mi.Bitmap(image)
bitmap.set_srgb_gamma(False)
bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt16, False).write(png)
print('version', mi.__version__)
