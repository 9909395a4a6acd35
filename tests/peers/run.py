#!/usr/bin/env python3
"""Run other renderers on what `rtfarm-report --for-peers FOLDER` wrote; leave what they made for
`rtfarm-report --peers FOLDER`.

    python3 run.py FOLDER CONVERTERS [--report rtfarm-report] [--runs 9] [--most 256] [--only WHAT]

CONVERTERS is a folder with rt.py, to_pov.py, to_tachyon.py and to_mitsuba.py, which turn a scene
into the renderer's own format. POV-Ray (povray), Tachyon (tachyon), Mitsuba 3 (the wheel in the
Python of MITSUBA_PYTHON) and Embree 3 (gcc and -lembree3) are skipped aloud where they are missing.

All get one thread, the same size, linear light and 16 bits a channel. Times are those that a
renderer tells of tracing alone; a picture's are those of each run.
  * POV-Ray: `+A0.0 +AM1 +Rn -J` is one ray and then n x n in every pixel whose first ray differs at
    all from its neighbours'; 9 is the largest n. A shape that all first rays miss is missed.
  * Tachyon: `-aasamples n` is n more rays than one; `-fullshade`. Its pixels lie about their
    corners, so its screen is moved by half a pixel.
  * Mitsuba: llvm_ad_rgb, the `path` integrator for direct light alone (`direct` adds light where it
    is far away), `independent` sampler, box filter; the render that compiles is not counted.
Scenes without a light show plain colours: the converted scene then has surfaces that shine by
themselves.
"""
import argparse
import array
import os
import re
import subprocess
import sys
import tempfile

HERE = os.path.dirname(os.path.abspath(__file__))
PYTHON = os.environ.get('MITSUBA_PYTHON', 'python3')
VALUE_NEXT = ('name', 'material', 'file')


def aloud(what):
    print(f'peers: {what}', file=sys.stderr, flush=True)


def by_lines(text):
    """The scene with one field a line, as the converters want it."""
    lines, last = [], None
    for word in text.split():
        if word[0].isalpha() and last not in VALUE_NEXT or not lines:
            lines.append(word)
        else:
            lines[-1] += ' ' + word
        last = word
    return '\n'.join(lines) + '\n'


def call(command, **more):
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                          errors='replace', **more)
    text = done.stdout.replace('\r', '\n')
    if done.returncode:
        raise RuntimeError(f'{" ".join(command)} failed:\n{text[-2000:]}')
    return text


def number(pattern, text):
    found = re.search(pattern, text, re.M)
    if not found:
        raise RuntimeError(f'no {pattern} in:\n{text[-2000:]}')
    return float(found[1])


class Povray:
    ending, picture = '.pov', '.png'
    settings = {1: '-A', **{n * n + 1: f'+A0.0 +AM1 +R{n} -J' for n in (2, 3, 4, 5, 6, 7, 8, 9)}}

    def version(self):
        done = subprocess.run(['povray', '--version'], capture_output=True, text=True)
        return 'POV-Ray ' + re.search(r'POV-Ray (\d[\d.]*\d)', done.stdout + done.stderr)[1]

    def convert(self, scene, path, width, height, samples):
        import to_pov
        with open(path, 'w') as f:
            to_pov.convert(scene, f.write, 8)
        if not scene.lights:
            edit(path, r'ambient 0 diffuse ([\d.e+-]+)', r'emission \1 diffuse 0')

    def render(self, source, picture, width, height, samples, runs):
        command = ['povray', source, f'+W{width}', f'+H{height}', '-D', '+WT1', 'File_Gamma=1.0',
                   '+FN16', '+O' + picture, *self.settings[samples].split()]
        for _ in range(runs):
            # Its wall time also has some tenths of a second of waiting for its own threads.
            yield number(r'Trace Time:.*\n\s*using \d+ thread\(s\) with ([\d.]+) CPU-seconds', call(command))

    def setting(self, samples):
        return self.settings[samples]


class Tachyon:
    ending, picture = '.dat', '.ppm'
    settings = [1, 8, 16, 32, 64, 128, 256, 512]

    def version(self):
        # It ends with a failure after its version.
        told = subprocess.run(['tachyon', '-version'], capture_output=True, text=True).stdout
        return 'Tachyon ' + re.search(r'\d+\.\d+', told)[0]

    def convert(self, scene, path, width, height, samples):
        import rt
        import to_tachyon
        with open(path, 'w') as f:
            to_tachyon.convert(scene, f.write, width, height, samples, 8)
        left, right, bottom, top = rt.frustum(scene.viewport)[4:]
        x, y = (right - left) / width / 2, (top - bottom) / height / 2
        edit(path, r'FRUSTUM .*', 'FRUSTUM %.9g %.9g %.9g %.9g' % (left - x, right - x, bottom - y, top - y))
        if not scene.lights:
            edit(path, r'AMBIENT 0 DIFFUSE ([\d.e+-]+)', r'AMBIENT \1 DIFFUSE 0')

    def render(self, source, picture, width, height, samples, runs):
        command = ['tachyon', source, '-res', str(width), str(height), '-format', 'PPM48', '-o', picture, '+V',
                   '-numthreads', '1', *self.setting(samples).split()]
        # Debian's takes its MPI build otherwise.
        library = {'LD_PRELOAD': 'libtachyon-mt-thr.so.0'}
        for _ in range(runs):
            yield number(r'Ray Tracing Time:\s+([\d.]+)', call(command, env={**os.environ, **library}))

    def setting(self, samples):
        return f'-aasamples {samples - 1} -fullshade'


class Mitsuba:
    ending, picture = '.xml', '.png'
    settings = [8, 16, 32, 64, 128, 256, 512]

    def version(self):
        return 'Mitsuba ' + call([PYTHON, '-c', 'import mitsuba; print(mitsuba.__version__)']).split()[-1]

    def convert(self, scene, path, width, height, samples):
        import to_mitsuba
        to_mitsuba.convert(scene, path, width, height, samples, 8)
        depth = 2 if scene.lights else 1
        edit(path, r'<integrator.*</integrator>',
             f'<integrator type="path"><integer name="max_depth" value="{depth}"/></integrator>')
        if not scene.lights:
            edit(path, r'(<ref id="M_(\w+)"/>)', lambda m: m[1] + self.shine(scene.materials[m[2]].color))

    @staticmethod
    def shine(color):
        value = ','.join('%.6g' % (c / 255) for c in color)
        return f'<emitter type="area"><rgb name="radiance" value="{value}"/></emitter>'

    def render(self, source, picture, width, height, samples, runs):
        text = call([PYTHON, os.path.join(HERE, 'mitsuba_picture.py'), source, picture, str(runs)])
        yield from map(float, re.findall(r'^render ([\d.]+)', text, re.M))

    def setting(self, samples):
        return f'sample_count={samples}'


def edit(path, pattern, replacement):
    with open(path) as f:
        text = f.read()
    with open(path, 'w') as f:
        f.write(re.sub(pattern, replacement, text))


def pictures(args, rt):
    """The lines of pictures.tsv."""
    with open(os.path.join(args.folder, 'size')) as f:
        width, height = map(int, f.read().split())
    scenes = {}
    for file in sorted(os.listdir(args.folder)):
        name, ending = os.path.splitext(file)
        if ending != '.rt':
            continue
        with open(os.path.join(args.folder, file)) as f, tempfile.NamedTemporaryFile('w', suffix='.rt') as lines:
            lines.write(by_lines(f.read()))
            lines.flush()
            try:
                scenes[name] = rt.load(lines.name)
            except rt.RtError as error:
                aloud(f'skipped: {name} cannot be converted: {str(error).split(": ")[-1]}')
    for peer in (Povray(), Tachyon(), Mitsuba()):
        kind = type(peer).__name__
        try:
            version = peer.version()
        except (OSError, RuntimeError, TypeError) as error:
            aloud(f'SKIPPED: {kind} is not there: {str(error).splitlines()[-1]}')
            continue
        for name, scene in scenes.items():
            for samples in (n for n in peer.settings if n <= args.most + 1):
                stem = f'{kind.lower()}-{name}-{samples}'
                source = os.path.join(args.folder, stem + peer.ending)
                file = stem + peer.picture
                path = os.path.join(args.folder, file)
                try:
                    peer.convert(scene, source, width, height, samples)
                    times = list(peer.render(source, path, width, height, samples, args.runs))
                except RuntimeError as error:
                    aloud(f'FAILED: {error}')
                    break
                # A time that is told as 0 is below the least that can be told.
                milliseconds = ','.join('%.4g' % max(1e3 * t, 0.01) for t in times)
                yield '\t'.join((name, version, peer.setting(samples), milliseconds, file))
            aloud(f'{version}: {name}')


class Kernels:
    """A program that traces what it is told to, as embree.c says: one order a line, one line of numbers back."""

    def __init__(self, name, isa, groups, command, **more):
        self.name, self.isa, self.groups = name, isa, groups
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **more)

    def ask(self, *order):
        self.process.stdin.write(' '.join(map(str, order)) + '\n')
        self.process.stdin.flush()
        return [float(number) for number in self.process.stdout.readline().split()]

    def end(self):
        self.process.stdin.close()
        self.process.wait()


def embree(folder):
    """Embree's kernels, built once; nothing, aloud, where it is missing."""
    program = os.path.join(folder, 'embree')
    try:
        call(['gcc', '-O3', '-o', program, os.path.join(HERE, 'embree.c'), '-lembree3'])
    except (OSError, RuntimeError):
        aloud('SKIPPED: Embree 3 is not there (gcc, libembree-dev)')
        return None
    return program


def isas():
    with open('/proc/cpuinfo') as f:
        flags = f.read().split()
    return [isa for isa, flag in (('avx2', 'avx2'), ('avx512', 'avx512vl')) if flag in flags]


def kernels(args, program):
    """The lines of kernels.tsv: one ray a call."""
    moves = sorted(file[5:] for file in os.listdir(args.folder) if file.startswith('mesh-'))
    for mode in ('fast', 'robust') if program else ():
        tracer = Kernels(f'Embree 3 {mode}', isas()[-1], (1,), [program, args.folder, isas()[-1], mode])
        for move in moves:
            tracer.ask('build', f'mesh-{move}')
            for aim in ('edges', 'corners', 'anywhere'):
                rays = f'rays-{move}-{aim}'
                count = os.path.getsize(os.path.join(args.folder, rays)) / 32
                times = [tracer.ask('trace', 'meet', 1, rays)[0] for _ in range(args.runs + 1)][1:]
                tracer.ask('tell', f'embree-{mode}-{move}-{aim}')
                speeds = ','.join(f'{count / time / 1e6:.4f}' for time in times)
                yield '\t'.join((tracer.name, move, aim, speeds, f'embree-{mode}-{move}-{aim}'))
        tracer.end()
        aloud(f'{tracer.name}: done')


def numbers(path):
    values = array.array('f')
    with open(path, 'rb') as f:
        values.frombytes(f.read())
    return values


def race(args, program):
    """The lines of race.tsv: every program takes its turn in every run."""
    if not args.report:
        return
    racers = []
    for isa in isas():
        command = [args.report, '--race', args.folder, '--isa', isa]
        racers.append(Kernels('rtfarm', isa, (64,), command, env={**os.environ, 'RAYON_NUM_THREADS': '1'}))
        for mode in ('fast', 'robust') if program else ():
            racers.append(Kernels(f'Embree {mode}', isa, (1, 64), [program, args.folder, isa, mode]))
    meshes = {int(file[5:]) for file in os.listdir(args.folder) if re.fullmatch(r'race-\d+', file)}
    for count in sorted(meshes):
        mesh = f'race-{count}'
        built = [[racer.ask('build', mesh) for racer in racers] for _ in range(args.builds)]
        for racer, runs in zip(racers, zip(*built)):
            seconds = lambda k: ','.join(f'{run[k]:.4g}' for run in runs)
            row = [count, 'build', racer.isa, racer.name, seconds(0), int(runs[0][1]), count]
            yield '\t'.join(map(str, row))
            if len(runs[0]) > 2:
                yield '\t'.join(map(str, [count, 'build', racer.isa, racer.name + ' all', seconds(2), *row[5:]]))
        for name in ('camera', 'shadow', 'anywhere'):
            rays = f'{mesh}-{name}'
            way = 'block' if name == 'shadow' else 'meet'
            turns = [(racer, group) for racer in racers for group in racer.groups]
            times = [[racer.ask('trace', way, group, rays)[0] for racer, group in turns]
                     for _ in range(args.runs + 1)][1:]
            most = numbers(os.path.join(args.folder, rays))[7::8]
            for (racer, group), runs in zip(turns, zip(*times)):
                racer.ask('trace', way, group, rays)
                racer.ask('tell', 'distances')
                distances = numbers(os.path.join(args.folder, 'distances'))
                leaks = sum(distance > limit for distance, limit in zip(distances, most))
                how = '' if racer.groups == (64,) else ' single' if group == 1 else ' streams'
                speeds = ','.join(f'{len(most) / time / 1e6:.4f}' for time in runs)
                yield '\t'.join((str(count), name, racer.isa, racer.name + how, speeds, str(leaks), str(len(most))))
        aloud(f'kernels on {count} triangles: done')
    for racer in racers:
        racer.end()


def main():
    args = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    args.add_argument('folder')
    args.add_argument('converters')
    args.add_argument('--runs', type=int, default=9)
    args.add_argument('--builds', type=int, default=3)
    args.add_argument('--report', help='rtfarm-report, whose kernels take turns with Embree\'s')
    args.add_argument('--only', choices=('kernels', 'race', 'pictures'))
    args.add_argument('--most', type=int, default=256, help='samples a pixel')
    args = args.parse_args()
    if not os.path.isfile(os.path.join(args.converters, 'rt.py')):
        sys.exit(f'peers: there are no converters in {args.converters}')
    sys.dont_write_bytecode = True
    sys.path.insert(0, args.converters)
    import rt
    with tempfile.TemporaryDirectory() as folder:
        program = embree(folder)
        made = {'kernels': kernels(args, program), 'race': race(args, program), 'pictures': pictures(args, rt)}
        for name, lines in made.items():
            if args.only in (None, name):
                with open(os.path.join(args.folder, name + '.tsv'), 'w') as f:
                    for line in lines:
                        f.write(line + '\n')
                        f.flush()


if __name__ == '__main__':
    main()
