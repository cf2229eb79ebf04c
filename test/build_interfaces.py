"""
Build Python type support for message packages into the running environment.

They are those of ROS 2 Jazzy in ``msg_adapters/interfaces``, and those in ``test/interfaces``. The
registries have no wheels of these message packages. The real rosidl generators build them from
their field lists. The type hashes equal those of the originals, so tests communicate with nodes
that use the originals. A package whose files have not changed since its build is skipped.

"""

from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory

HERE = Path(__file__).resolve().parent / 'interfaces'
FOLDERS = (HERE, HERE.parents[1] / 'msg_adapters' / 'interfaces' / 'jazzy')
PREFIX = Path(sys.prefix)
MANIFEST = """<package format="3">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>Field lists, for tests</description>
  <maintainer email="boxreg@example.com">boxreg_ros developers</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
PROJECT = """cmake_minimum_required(VERSION 3.16)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
foreach(package {depends})
  find_package(${{package}} REQUIRED)
endforeach()
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {depends})
ament_package()
"""


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
    with ThreadPoolExecutor(2) as pool:  # one compiles while the next one generates
        for package, error in zip(packages, pool.map(build, packages), strict=True):
            if error:
                sys.exit(f'{package.name}: {error}')
            stamp(package).write_text(digest(package))


def stamp(package: Path) -> Path:
    """Return the file with the digest of the files that a package was built from."""
    return PREFIX / 'share' / package.name / 'test_interfaces.sha256'


def digest(package: Path) -> str:
    """Return a digest of the files that a package is built from."""
    files = [*sorted(package.glob('msg/*.msg')), HERE / 'fix_wheel_paths.cmake', Path(__file__)]
    return sha256(b''.join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()


def is_built(package: Path) -> bool:
    """Return whether the installed package was built from the present files."""
    return stamp(package).exists() and stamp(package).read_text() == digest(package)


def build(package: Path) -> str:
    """Configure, build and install one package; return an error message, or an empty one."""
    # Variables that Python sets at its start for the ROS wheels break cmake and the generators.
    foreign = {'LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'PYTHONPATH'}
    environment = {key: value for key, value in os.environ.items() if key not in foreign}
    environment['PATH'] = f'{PREFIX / "bin"}{os.pathsep}{environment["PATH"]}'
    environment['CMAKE_PREFIX_PATH'] = environment['AMENT_PREFIX_PATH'] = str(PREFIX)
    with TemporaryDirectory() as folder:
        source = Path(folder, 'source')
        shutil.copytree(package, source)
        write_project(source, package.name)
        configure = ['cmake', '-S', source, '-B', f'{folder}/build', '-G', 'Ninja', '-Wno-dev']
        settings = {
            'CMAKE_BUILD_TYPE': 'None',  # no optimisation: the quickest to compile
            'CMAKE_INSTALL_PREFIX': PREFIX,
            'CMAKE_PROJECT_INCLUDE': HERE / 'fix_wheel_paths.cmake',
            'Python3_EXECUTABLE': PREFIX / 'bin' / 'python',
            'Python3_FIND_VIRTUALENV': 'ONLY',
            'BUILD_TESTING': 'OFF',
        }
        configure += [f'-D{name}={value}' for name, value in settings.items()]
        install = ['cmake', '--build', f'{folder}/build', '--target', 'install']
        for command in (configure, install):
            done = subprocess.run(
                command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )
            if done.returncode:
                return f'{command[:2]} failed:\n{done.stdout.decode()[-5000:]}'
    return ''


def write_project(source: Path, name: str) -> None:
    """Write the manifest and the CMake project for the field lists in ``source/msg``."""
    files = sorted(source.glob('msg/*.msg'))
    used = {u for f in files for u in re.findall(r'^(\w+)/', f.read_text(), re.MULTILINE)}
    fields = {
        'name': name,
        'depends': ' '.join(sorted(used - {name})),
        'files': ' '.join(f'msg/{path.name}' for path in files),
    }
    (source / 'package.xml').write_text(MANIFEST.format(**fields))
    (source / 'CMakeLists.txt').write_text(PROJECT.format(**fields))


if __name__ == '__main__':
    main()
