"""Parts of numba that dynsim replaces in its own compilations, and the numba version for which it replaces them.

With another numba version, the replacements could produce wrong machine code without an error. Another minor version is
therefore rejected when this module is imported, before numba's internals are imported; a change in the source of a
replaced part is rejected before a kernel is compiled. After a review of such changes,
``python -m dynsim.jit.numba_version`` prints the new table.
"""

from __future__ import annotations

import hashlib
import inspect
import pkgutil
from functools import cache

import numba

SUPPORTED = "0.68.1"

# First 32 digits of the SHA-256 of the source of each part that is replaced or copied, by its name in numba.
REPLACED = {
    "numba.core.codegen:CPUCodeLibrary._optimize_functions": "9439219fa946f1ad5d202cb5dcbd2d51",
    "numba.core.codegen:CPUCodeLibrary._optimize_final_module": "e405bd473752613ba43e3becff2b625a",
    "numba.core.codegen:CPUCodeLibrary.finalize": "4b4c34b83488a72fea5f3d836a8a9f72",
    "numba.core.codegen:CPUCodeLibrary.serialize_using_object_code": "a895c26d01bad670463c4b4f1013b3c1",
    "numba.core.codegen:CPUCodeLibrary._unserialize": "c83d278d993487f35768b1aca22ca2c6",
    "numba.core.compiler:CompilerBase.compile_extra": "09b90ed8a19dfc12d292b5df3b3e5dd0",
    "numba.core.compiler:CompileResult._reduce": "5f86eacfa5202c202b3dc200f1a7a9b6",
    "numba.core.compiler:CompileResult._rebuild": "44fa9dc2255883ab49195d18c3cca8c0",
    "numba.core.compiler:DefaultPassBuilder.define_nopython_pipeline": "d643d727077eeb492cbb19c9faa7eda2",
    "numba.core.compiler:DefaultPassBuilder.define_untyped_pipeline": "0cb11451d06eef493a9959a4fced3d1d",
    "numba.core.compiler:DefaultPassBuilder.define_typed_pipeline": "bd5ccc7ef772a33a2075ae4f7bb3aa1f",
    "numba.core.compiler:DefaultPassBuilder.define_nopython_lowering_pipeline": "9e7ddc0e96eaaecfc024833eb6757cdb",
    "numba.core.dispatcher:_DispatcherBase.get_call_template": "f15b62d0e9c0f6052c48a2a69ef378ac",
    "numba.core.dispatcher:_DispatcherBase.get_overload": "7dd56f622edd2016377021a5835d5a82",
    "numba.core.dispatcher:Dispatcher.compile": "0ab4aee15e79bb1d17c7d87c3b6e61f3",
    "numba.core.lowering:Lower._lower_call_normal": "ff84f88a6d07d7c41697a4c4531d3f79",
    "numba.core.lowering:Lower.loadvar": "dc1f6093a6145137a369222b01703410",
    "numba.core.lowering:Lower.storevar": "16d897dd729a5836fc2d7d91fc47e618",
    "numba.core.typed_passes:BaseNativeLowering.run_pass": "0b482df4865451f4163c61506423e5fc",
    "numba.core.typed_passes:NativeLowering.lowering_class": "15e5a08796b58a082ddcf71ae8a4dbb4",
    "numba.core.boxing:unbox_tuple": "864513414bf1549589075c22099fff91",
    "numba.core.boxing:box_namedtuple": "6c9d9587027b3477903860a7ec0af7ff",
    "numba.core.typing.typeof:_typeof_tuple": "b66c93fcf165d5a450fcc093dba93d86",
    "numba.core.typing.collections:NamedTupleClassAttribute.resolve___call__": "877d70abc4a3303bc08288da318da09c",
    "numba.core.typing.context:BaseContext._get_attribute_templates": "c6739afafca9833a74a3d917e014ed38",
    "numba.core.types.functions:BaseFunction.get_call_type": "6559c167bfc0ad36ab4af049ed2f2b9d",
    "numba.core.ir:Inst._rec_list_vars": "054700e9100b6299de3cb0d97f294acd",
    "numba.core.typing.templates:_OverloadFunctionTemplate._get_impl": "4e27d07b214ca16d6e8ed88f70d886b6",
    "numba.core.typing.templates:_OverloadFunctionTemplate._build_impl": "12c12b30a1b799381c90cef5c9cd446c",
    "numba.cpython.tupleobj:namedtuple_constructor": "3a45bad5e04389db8701e8ddb996d058",
    "numba.cpython.tupleobj:namedtuple_getattr": "54ffd696e4e9fd33cb7da5ee75c54324",
}


def source_hash(name: str) -> str:
    """Return the first 32 digits of the SHA-256 of the source of a numba function or property; empty if not found."""
    try:
        function = pkgutil.resolve_name(name)
        source = inspect.getsource(getattr(function, "fget", function))
    except (ImportError, AttributeError, OSError, TypeError):
        return ""
    return hashlib.sha256(source.encode()).hexdigest()[:32]


@cache
def check_sources() -> None:
    """Check that the replaced parts of numba are unchanged.

    Raises
    ------
    ImportError
        If a part differs from the numba version for which the replacements were written.
    """
    for name, digest in REPLACED.items():
        if source_hash(name) != digest:
            raise _refused(f"; {name}, which dynsim replaces, differs")


def _refused(why: str = "") -> ImportError:
    return ImportError(
        f'numba {numba.__version__} is installed, dynsim needs numba {SUPPORTED}{why}: pip install "numba=={SUPPORTED}"'
    )


if numba.__version__.split(".")[:2] != SUPPORTED.split(".")[:2]:
    raise _refused()

if __name__ == "__main__":
    for name in REPLACED:
        print(f'    "{name}": "{source_hash(name)}",')
