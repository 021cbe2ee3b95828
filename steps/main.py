"""Entry point of every step: `python -m steps.main REQUEST.json RESULT.json [--store STORE] [--progress FILE]`.

Reads a StepRequest and writes a StepResult, or a StepFailure in its place. Progress is written to standard output as
JSON lines, {"done": 3, "total": 10, "values": {"loss": 0.1}}, and so are notes of the library, {"note": "..."},
and pictures of the work so far, {"picture": PNG in base64}; everything else that is printed goes to standard error.

Exit status: 0 done · 65 bad input or settings, or no disk space: the same request will fail again · 69 something is
missing · 70 the optimization diverged · 75 the store does not answer at the moment · 137 out of memory · 1 anything
else, which may be tried again.

`$DG4D_CATALOG` ("module:name") names another catalog than `steps.catalog:STEPS`; `$DG4D_STORE` and `$DG4D_HOME` locate
the store when `--store` is not given; `$DG4D_CODE_VERSION` replaces the digest of the source.
"""

import sys

from steps.runtime.program import main

if __name__ == "__main__":
    sys.exit(main())
