#!/usr/bin/env python3
"""Time whole commands of rtfarm and of other renderers: meshes and spheres beside Mitsuba, solids beside
POV-Ray with the same samples, and with as few as an error needs.

    python3 whole.py RTFARM CONVERTERS [--runs 3] [--only meshes|equal|same|adaptive]
                     [--scene WORD] [--quiet COMMAND]

RTFARM is the program, CONVERTERS the folder with rt.py, to_pov.py, to_mitsuba.py, mitsuba_run.py and
gen_scenes.py. Prints tables of medians of runs that take turns; one whose renderer is missing is
skipped aloud. Mitsuba 3 is the wheel in the Python of MITSUBA_PYTHON (`llvm_ad_rgb`, kernels compiled
before, rays of mirrors and glass alone), and rtfarm has its default workers beside it; memory is
the greatest sum of the proportional set sizes (PSS) of all processes of one further run. On solids both
programs have two threads, no secondary light, rtfarm's depth and linear light. POV-Ray's 17 samples are one and then 4 x 4; its adaptive ones are `+AM2`. An error is the root
of the mean square against the program's own converged picture, in steps of 8 bits: POV-Ray's has
9 x 9 samples in each quarter of a pixel, rtfarm's 1024 a pixel; of meshes and spheres both have 256. Each POV-Ray row has beside it the
coarsest `--error` of a ladder by sqrt(2) that comes at least as near. Of the meshes and spheres only those
whose name has WORD are taken. COMMAND is put before each
round of commands that are timed.
"""
import argparse
import json
import math
import os
import re
import shlex
import shutil
import statistics
import struct
import subprocess
import sys
import tempfile
import time
import zlib

from run import PYTHON, by_lines

SCENES = os.path.join(os.path.dirname(os.path.abspath(__file__)), '..', '..', 'scenes')
MESHES = [('bottle, 100 000 triangles, front', 'bottle 100000 --view front'),
          ('bottle, 100 000 triangles, filling the frame', 'bottle 100000 --view fill'),
          ('bottle, 1 000 000 triangles, front', 'bottle 1000000 --view front'),
          ('100 000 spheres', 'spheres 100000'),
          ('mirrors', 'mirrors')]
# Rays that a path has in a row at most: rtfarm traces depths 0 to 64.
DEPTH = 65
SAME = [('gnome', 640, 360), ('gnome', 1280, 720), ('solids', 640, 360)]
GRID = '+A0.0 +AM1 +R4 -J'
ADAPTIVE = ['+A0.3 +AM2 +R2 -J', '+A0.1 +AM2 +R3 -J', '+A0.03 +AM2 +R4 -J', '+A0.01 +AM2 +R5 -J']
ERRORS = ['%.3g' % (32 * 2 ** (-k / 2) / 255) for k in range(17)]


def read_png(path):
    """Rows of numbers 0..1, channels side by side."""
    with open(path, 'rb') as f:
        data = f.read()
    at, packed = 8, b''
    while at < len(data):
        length, kind = struct.unpack('>I4s', data[at:at + 8])
        body = data[at + 8:at + 8 + length]
        if kind == b'IHDR':
            width, height, depth, color = struct.unpack('>IIBB', body[:10])
        packed += body if kind == b'IDAT' else b''
        at += 12 + length
    pixel = {0: 1, 2: 3, 6: 4}[color] * depth // 8
    raw, stride, rows = zlib.decompress(packed), width * pixel, []
    above = bytearray(stride)
    for y in range(height):
        kind, row = raw[y * (stride + 1)], bytearray(raw[y * (stride + 1) + 1:(y + 1) * (stride + 1)])
        for i in range(stride if kind else 0):
            a, b = (row[i - pixel] if i >= pixel else 0), above[i]
            c = above[i - pixel] if i >= pixel else 0
            nearest = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            row[i] = row[i] + (0, a, b, (a + b) // 2, nearest)[kind] & 255
        above = row
        numbers = struct.unpack('>%d%s' % (stride * 8 // depth, 'H' if depth == 16 else 'B'), row)
        rows.append([x / (2 ** depth - 1) for x in numbers])
    return rows, pixel * 8 // depth


def halved(picture):
    rows, channels = picture
    return [[(a[i] + a[i + channels] + b[i] + b[i + channels]) / 4
             for p in range(0, len(a), 2 * channels) for i in range(p, p + channels)]
            for a, b in zip(rows[::2], rows[1::2])], channels


def error(picture, truth):
    (rows, m), (truths, n) = picture, truth
    squares = [(row[m * x + c] - true[n * x + c]) ** 2
               for row, true in zip(rows, truths) for x in range(len(row) // m) for c in range(3)]
    return 255 * statistics.fmean(squares) ** 0.5


def run(command):
    """Wall and processor seconds."""
    before, start = os.times(), time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors='replace')
    wall, after = time.perf_counter() - start, os.times()
    if done.returncode:
        sys.exit(f'{shlex.join(command)} failed:\n{done.stdout[-2000:]}')
    return wall, sum(after[2:4]) - sum(before[2:4])


def processes(root):
    """A process and all that descend from it."""
    children, found = {}, [root]
    for pid in filter(str.isdigit, os.listdir('/proc')):
        try:
            with open(f'/proc/{pid}/stat') as f:
                children.setdefault(int(f.read().rsplit(')', 1)[1].split()[1]), []).append(int(pid))
        except OSError:
            pass
    for pid in found:
        found += children.get(pid, [])
    return found


def peak_memory(command):
    """The greatest sum of the proportional set sizes of all processes of a command, in megabytes."""
    most, process = 0, subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None:
        sum_now = 0
        for pid in processes(process.pid):
            try:
                with open(f'/proc/{pid}/smaps_rollup') as f:
                    sum_now += int(re.search(r'^Pss: *(\d+)', f.read(), re.M)[1])
            except (OSError, TypeError):
                pass
        most = max(most, sum_now)
        time.sleep(0.01)
    return most * 1024 / 1e6


class Bench:
    def __init__(self, args, folder):
        self.args, self.folder = args, folder
        self.quiet = shlex.split(args.quiet)
        for file in os.listdir(SCENES):
            os.symlink(os.path.abspath(os.path.join(SCENES, file)), os.path.join(folder, file))

    def timed(self, commands):
        if not self.quiet:
            return [run(command) for command in commands]
        # What waits until it may run is not counted: this program times itself within it.
        done = subprocess.run([*self.quiet, sys.executable, __file__, '--timed', json.dumps(commands)],
                              stdout=subprocess.PIPE, check=True, text=True)
        return json.loads(done.stdout)

    def povray(self, scene, width, height, flags):
        source = os.path.join(self.folder, scene + '.pov')
        if not os.path.exists(source):
            with open(os.path.join(SCENES, scene + '.rt')) as f, open(source + '.rt', 'w') as lines:
                lines.write(by_lines(re.sub('#.*', '', f.read())))
            convert = os.path.join(self.args.converters, 'to_pov.py')
            run([sys.executable, convert, source + '.rt', source, '--depth', '64', '--cutoff', '0.000244140625'])
        return ['povray', source, f'+W{width}', f'+H{height}', '-D', '+WT2', 'File_Gamma=1.0',
                '+O' + self.picture('pov', scene), *flags.split()]

    def rtfarm(self, scene, width, height, flags):
        return [self.args.rtfarm, 'render', os.path.join(SCENES, scene + '.rt'), '--size', f'{width}x{height}',
                '-o', self.picture('rtfarm', scene), '--secondary', 'off', '--workers', '0', '--threads', '2',
                *flags.split()]

    def picture(self, program, scene):
        return os.path.join(self.folder, f'{program}-{scene}.png')

    def medians(self, commands):
        """Of commands in turns: the medians of wall and processor seconds."""
        runs = [self.timed(commands) for _ in range(self.args.runs)]
        return [[statistics.median(times) for times in zip(*of)] for of in zip(*runs)]

    def scenes(self):
        return [(name, scene) for name, scene in MESHES if self.args.scene in name]

    def generated(self, scene):
        """The path of a scene of gen_scenes.py, told as its arguments."""
        # Not beside the links to the project's scenes, which are written through.
        made = os.path.join(self.folder, 'made')
        os.makedirs(made, exist_ok=True)
        kind, *rest = scene.split()
        source = os.path.join(made, '-'.join(scene.split()) + '.rt')
        if not os.path.exists(source):
            run([sys.executable, self.converter('gen_scenes.py'), kind, *rest[:1], source, *rest[1:]])
        return source

    def converter(self, name):
        return os.path.join(self.args.converters, name)

    def mitsuba(self, source, samples, sampler='independent'):
        xml = f'{source}-{samples}.xml'
        run([sys.executable, self.converter('to_mitsuba.py'), source, xml, '1280', '720', '--spp', str(samples)])
        with open(xml) as f:
            converted = f.read()
        with open(xml, 'w') as f:
            f.write(converted.replace('sampler type="independent"', f'sampler type="{sampler}"'))
        return [PYTHON, self.converter('mitsuba_run.py'), xml, self.picture('mitsuba', 'mesh'),
                '--whitted', str(DEPTH)]

    def whole(self, source, flags):
        return [self.args.rtfarm, 'render', source, '-o', self.picture('rtfarm', 'mesh'), '--size', '1280x720',
                '--secondary', 'off', '--no-cache', *flags.split()]

    def meshes(self):
        print('| 1280 x 720 | samples | Mitsuba: wall, processor s; MB | rtfarm | Mitsuba / rtfarm |'
              '\n|---|---|---|---|---|')
        for name, scene in self.scenes():
            source = self.generated(scene)
            for samples in (1, 16):
                peer = self.mitsuba(source, samples)
                own = self.whole(source, f'--samples {samples}')
                memory = [peak_memory(command) for command in (peer, own)]
                times = self.medians([peer, own])
                cells = [f'{wall:.2f}, {processor:.2f}; {most:.0f}' for (wall, processor), most in zip(times, memory)]
                ratios = [a / b for a, b in zip([*times[0], memory[0]], [*times[1], memory[1]])]
                print(f'| {name} | {samples} | {cells[0]} | {cells[1]} '
                      f'| {ratios[0]:.2f}, {ratios[1]:.2f}; {ratios[2]:.1f} |', flush=True)
        print()

    def equal(self):
        """To a root mean square error of one step of 8 bits, both pictures in 8 bits."""
        print('| 1280 x 720 | Mitsuba: samples, error; wall, processor s | rtfarm: samples, error; wall, processor s '
              '| Mitsuba / rtfarm | `--error`, error; wall, processor s | Mitsuba / rtfarm |\n|---|---|---|---|---|---|')
        path = {program: self.picture(program, 'mesh') for program in ('mitsuba', 'rtfarm')}

        def first_within(program, truth, ladder, command):
            for step in ladder:
                found = command(step)
                run(found)
                if (missed := error(read_png(path[program]), truth)) <= 1:
                    break
            return step, missed, found

        for name, scene in self.scenes():
            source = self.generated(scene)
            run(self.mitsuba(source, 256, 'multijitter'))
            truth = read_png(path['mitsuba'])
            squares = [1, 4, 9, 16, 25, 36, 64]
            found = [first_within('mitsuba', truth, squares, lambda n: self.mitsuba(source, n, 'multijitter'))]
            run(self.whole(source, '--samples 256'))
            truth = read_png(path['rtfarm'])
            counts = [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64]
            found += [first_within('rtfarm', truth, counts, lambda n: self.whole(source, f'--samples {n}')),
                      first_within('rtfarm', truth, ERRORS, lambda level: self.whole(source, f'--error {level}'))]
            times = self.medians([command for _, _, command in found])
            steps = [str(step) for step, _, _ in found[:2]] + [f'{255 * float(found[2][0]):.2g}/255']
            cells = [f'{step}, {missed:.2f}; {wall:.2f}, {processor:.2f}'
                     for step, (_, missed, _), (wall, processor) in zip(steps, found, times)]
            ratios = [f'{times[0][0] / wall:.2f}, {times[0][1] / processor:.2f}' for wall, processor in times[1:]]
            print(f'| {name} | {cells[0]} | {cells[1]} | {ratios[0]} | {cells[2]} | {ratios[1]} |', flush=True)
        print()

    def same_samples(self):
        print('| scene | POV-Ray, 17 samples: wall, processor s | rtfarm, 16 | rtfarm / POV-Ray |\n|---|---|---|---|')
        for scene, width, height in SAME:
            pov, own = self.medians([self.povray(scene, width, height, GRID),
                                     self.rtfarm(scene, width, height, '--samples 16')])
            print(f'| {scene}, {width} x {height} | {pov[0]:.2f}, {pov[1]:.2f} | {own[0]:.2f}, {own[1]:.2f} '
                  f'| {own[0] / pov[0]:.2f}, {own[1] / pov[1]:.2f} |', flush=True)

    def adaptive(self, width=320, height=180):
        print(f'| {width} x {height} | POV-Ray | error | wall, processor s | `--error` | error | wall, processor s |'
              '\n|---|---|---|---|---|---|---|')
        for scene in ('solids', 'glass', 'gnome'):
            path = {program: self.picture(program, scene) for program in ('pov', 'rtfarm')}
            run(self.povray(scene, 2 * width, 2 * height, '+A0.0 +AM1 +R9 -J +FN16'))
            truth = {'pov': halved(read_png(path['pov']))}
            run(self.rtfarm(scene, width, height, '--samples 1024 --depth 16'))
            truth['rtfarm'] = read_png(path['rtfarm'])
            reached = {}
            for flags in ['-A', *ADAPTIVE, GRID]:
                povray = self.povray(scene, width, height, flags)
                run(povray)
                wanted = error(read_png(path['pov']), truth['pov'])
                for level in ERRORS:
                    own = self.rtfarm(scene, width, height, f'--error {level} --max-samples 4096')
                    if level not in reached:
                        run(own)
                        reached[level] = error(read_png(path['rtfarm']), truth['rtfarm'])
                    if reached[level] <= wanted:
                        break
                pov, own = self.medians([povray, own])
                print(f'| {scene} | `{flags}` | {wanted:.2f} | {pov[0]:.2f}, {pov[1]:.2f} '
                      f'| {255 * float(level):.2g}/255 | {reached[level]:.2f} | {own[0]:.2f}, {own[1]:.2f} |', flush=True)


def skip(what):
    print(f'SKIPPED: {what}', file=sys.stderr, flush=True)


def main():
    if sys.argv[1:2] == ['--timed']:
        print(json.dumps([run(command) for command in json.loads(sys.argv[2])]))
        return
    args = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    args.add_argument('rtfarm')
    args.add_argument('converters')
    args.add_argument('--runs', type=int, default=3)
    args.add_argument('--only', choices=['meshes', 'equal', 'same', 'adaptive'])
    args.add_argument('--scene', default='', metavar='WORD')
    args.add_argument('--quiet', default='', metavar='COMMAND')
    args = args.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(args, folder)
        if args.only in (None, 'meshes', 'equal'):
            if subprocess.run([PYTHON, '-c', 'import mitsuba'], stderr=subprocess.DEVNULL).returncode:
                skip('meshes: there is no Mitsuba in the Python of MITSUBA_PYTHON')
            else:
                if args.only != 'equal':
                    bench.meshes()
                if args.only != 'meshes':
                    bench.equal()
        if args.only in ('meshes', 'equal'):
            return
        if not shutil.which('povray'):
            return skip('solids: there is no povray')
        if args.only != 'adaptive':
            bench.same_samples()
            print()
        if args.only != 'same':
            bench.adaptive()


if __name__ == '__main__':
    sys.dont_write_bytecode = True
    main()
