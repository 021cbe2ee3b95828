"""Records of packages that no flow wrote."""

import json
from pathlib import Path

from flows.packages.publish import file_digest


def add_record(folder: Path, item: str = "gem <&> stone") -> None:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "provenance.json"]
    facts = {path.relative_to(folder).as_posix(): file_digest(path) for path in files}
    (folder / "provenance.json").write_text(json.dumps({"item": item, "files": facts}))
