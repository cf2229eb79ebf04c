"""
Build Python type support for the packages in ``test/interfaces`` into the running environment.

The registries have no wheels of vision_msgs and tf2_msgs. Where those cannot be imported, the
real rosidl generators build them from their field lists: the type hashes equal those of the
originals, so the tests speak to nodes that use the originals. Does nothing when they are there.

"""

from hashlib import sha256
import os
from pathlib import Path
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory

HERE = Path(__file__).resolve().parent / 'interfaces'
PREFIX = Path(sys.prefix)


def main() -> None:
    """Build what is not built yet, in the state that it has now."""
    files = sorted(path for path in HERE.rglob('*') if path.is_file())
    digest = sha256(b''.join(str(p.relative_to(HERE)).encode() + p.read_bytes() for p in files))
    stamp = PREFIX / 'share' / 'test_interfaces.sha256'
    if stamp.exists() and stamp.read_text() == digest.hexdigest():
        return
    compiler = os.environ.get('CXX', 'c++')
    if shutil.which(compiler) is None:
        sys.exit(f'no C++ compiler {compiler!r} to build message types with: apt install g++')
    for package in sorted(path.parent for path in HERE.glob('*/package.xml')):
        print(f'building message types of {package.name} ...', flush=True)
        build(package)
    stamp.write_text(digest.hexdigest())


def build(package: Path) -> None:
    """Configure, build and install one package; show the log if that fails."""
    # What python's own start has set for the ROS wheels is not for cmake or the generators.
    foreign = {'LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'PYTHONPATH'}
    environment = {key: value for key, value in os.environ.items() if key not in foreign}
    environment['PATH'] = f'{PREFIX / "bin"}{os.pathsep}{environment["PATH"]}'
    environment['CMAKE_PREFIX_PATH'] = environment['AMENT_PREFIX_PATH'] = str(PREFIX)
    with TemporaryDirectory() as folder:
        configure = ['cmake', '-S', package, '-B', folder, '-G', 'Ninja', '-Wno-dev']
        settings = {
            'CMAKE_BUILD_TYPE': 'MinSizeRel',  # the quickest to compile
            'CMAKE_INSTALL_PREFIX': PREFIX,
            'CMAKE_PROJECT_INCLUDE': HERE / 'fix_wheel_paths.cmake',
            'Python3_EXECUTABLE': PREFIX / 'bin' / 'python',
            'Python3_FIND_VIRTUALENV': 'ONLY',
            'BUILD_TESTING': 'OFF',
        }
        configure += [f'-D{name}={value}' for name, value in settings.items()]
        for command in (configure, ['cmake', '--build', folder, '--target', 'install']):
            done = subprocess.run(
                command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )
            if done.returncode:
                sys.exit(f'{package.name}: {command[:2]} failed:\n{done.stdout.decode()[-5000:]}')


if __name__ == '__main__':
    main()
