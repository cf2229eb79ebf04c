"""
Build Python type support for message packages into the running environment.

They are those of ROS 2 Jazzy in ``msg_adapters/interfaces``, and those in ``test/interfaces``. The
registries have no wheels of these message packages. The real rosidl generators build them from
their field lists. The type hashes equal those of the originals, so tests communicate with nodes
that use the originals. A package whose files have not changed since its build is skipped.

"""

from concurrent.futures import ProcessPoolExecutor
from functools import cache
from hashlib import sha256
from io import StringIO
import logging
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import sysconfig
from tempfile import TemporaryDirectory

HERE = Path(__file__).resolve().parent / 'interfaces'
FOLDERS = (HERE, HERE.parents[1] / 'msg_adapters' / 'interfaces' / 'jazzy')
PREFIX = Path(sys.prefix)
SITE = Path(sysconfig.get_path('platlib'))
MANIFEST = '<package format="3"><name>{}</name></package>'
IMPLEMENTATIONS = ('fastrtps_c', 'introspection_c')
"""Type supports that the middleware asks for: to read and write messages, to describe types."""


def main() -> None:
    """Build the packages that are new or changed."""
    found = sorted(path for folder in FOLDERS for path in folder.iterdir() if path.is_dir())
    packages = [path for path in found if not is_built(path)]
    for package in packages:
        stamp(package).unlink(missing_ok=True)  # a hard link to it may be in another environment
    compiler = os.environ.get('CXX', 'c++')
    if packages and shutil.which(compiler) is None:
        sys.exit(f'no C++ compiler {compiler!r} to build message types with: apt install g++')
    if packages:
        print(f'building message types of {", ".join(p.name for p in packages)} ...', flush=True)
    with ProcessPoolExecutor(initializer=silence) as pool:
        list(pool.map(build, packages, [compiler] * len(packages)))


def silence() -> None:
    """Drop what the generators print; empy demands that the process keeps one stdout."""
    sys.stdout = StringIO()


def stamp(package: Path) -> Path:
    """Return the file with the digest of the files that a package was built from."""
    return SITE / package.name / 'test_interfaces.sha256'


def digest(package: Path) -> str:
    """Return a digest of the files that a package is built from."""
    files = [*sorted(package.glob('msg/*.msg')), Path(__file__)]
    return sha256(b''.join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()


def is_built(package: Path) -> bool:
    """Return whether the installed package was built from the present files."""
    return stamp(package).exists() and stamp(package).read_text() == digest(package)


def build(package: Path, compiler: str) -> None:
    """Generate, compile and install one package."""
    name = package.name
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        generate(package, folder)
        module = folder / 'py' / name
        library = f'{name}_s__rosidl_typesupport_c.so'
        compile_package(package, folder, compiler, module / library)
        (module / '__init__.py').touch()
        shutil.rmtree(SITE / name, ignore_errors=True)
        shutil.copytree(module, SITE / name, ignore=shutil.ignore_patterns('*.c'))
    for implementation in IMPLEMENTATIONS:  # where the middleware looks for them
        link = PREFIX / 'lib' / f'lib{name}__rosidl_typesupport_{implementation}.so'
        link.unlink(missing_ok=True)
        link.symlink_to(os.path.relpath(SITE / name / library, link.parent))
    stamp(package).write_text(digest(package))


def generate(package: Path, folder: Path) -> None:
    """Generate the sources of a package: ``FOLDER/GENERATOR/PACKAGE/msg``."""
    os.environ['AMENT_PREFIX_PATH'] = str(PREFIX)
    logging.disable(logging.WARNING)  # each generator is registered twice in its wheel
    from rosidl_adapter.cli import TranslateMsgToIDL
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_parser import parser
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    # Each generator parses each file again, by Earley's method: a quarter of the time of all.
    parser.get_ast_from_idl_string = cache(parser.get_ast_from_idl_string)
    generators = (
        GenerateC('c'),
        GeneratePython('py'),
        GenerateCTypesupport('typesupport'),
        GenerateFastRTPSCTypesupport('fastrtps_c'),
        GenerateIntrospectionCTypesupport('introspection_c'),
    )
    name = package.name
    source = folder / 'source'
    shutil.copytree(package, source)
    (source / 'package.xml').write_text(MANIFEST.format(name))
    included = [str(PREFIX / 'share')]
    files = [f'{source}:msg/{path.name}' for path in sorted(source.glob('msg/*.msg'))]
    translator = TranslateMsgToIDL('msg2idl')
    files = list(translator.translate(name, files, included, folder / 'idl'))
    for generator in generators:
        generator.generate(name, files, included, folder / generator.name / name)


def compile_package(package: Path, folder: Path, compiler: str, library: Path) -> None:
    """
    Compile the generated sources of a package into one library.

    Most of the time goes into headers: files whose names do not clash are compiled as one.

    """
    import numpy

    name = package.name
    entry = library.with_name(f'_{name}_s.ep.rosidl_typesupport_c.c')
    patterns = 'py/*/msg/*.c', 'introspection_c/**/*.c', 'c/**/*__functions.c', 'c/**/*__type_*.c'
    together = {
        'python.c': [entry, *(path for one in patterns for path in folder.glob(one))],
        'support.cpp': list(folder.glob('*/*/msg/**/*.cpp')),
    }
    for file, paths in together.items():
        (folder / file).write_text(''.join(f'#include "{path}"\n' for path in paths))
    headers = [
        *folder.iterdir(), PREFIX / 'include', *PREFIX.glob('include/*'),
        sysconfig.get_path('include'), numpy.get_include(),
    ]  # fmt: skip
    texts = [path.read_text() for path in package.glob('msg/*.msg')]
    used = {name for text in texts for name in re.findall(r'^(\w+)/', text, re.MULTILINE)}
    kinds = ('generator_c', 'generator_py', *(f'typesupport_{kind}' for kind in IMPLEMENTATIONS))
    libraries = [
        *(f'{name}__rosidl_{kind}' for name in sorted(used - {package.name}) for kind in kinds),
        *(f'rosidl_typesupport_{kind}' for kind in ('c', 'fastrtps_cpp', *IMPLEMENTATIONS)),
        *('rosidl_runtime_c', 'rmw', 'rcutils', ':libfastcdr.so.2'),
    ]
    command = [
        compiler, '-shared', '-fPIC', '-w', *(f'-I{path}' for path in headers),
        '-x', 'c', folder / 'python.c', *folder.glob('c/**/*__description.c'),
        '-x', 'c++', folder / 'support.cpp',
        f'-L{PREFIX}/lib', *(f'-l{library}' for library in libraries), '-o', library,
    ]  # fmt: skip
    subprocess.run(command, check=True)


if __name__ == '__main__':
    main()
