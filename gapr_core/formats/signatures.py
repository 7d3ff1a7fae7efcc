"""What a file is by its first bytes, where its name says something else."""

from __future__ import annotations

from pathlib import Path

STL_HEADER_BYTES, STL_FACET_BYTES = 84, 50
SIGNATURES = {
    b"ply": ".ply",
    b"solid": ".stl",
    b"# .PCD": ".pcd",
    b"# vtk DataFile": ".vtk",
    b"<VTKFile": ".vtp",
    b"\x93NUMPY": ".npy",
    b"PK\x03\x04": ".npz",
    b"NRRD": ".nrrd",
    b"ObjectType": ".mha",
}


def ending_of(path: Path) -> str:
    """The ending that the content asks for; empty where the content does not tell, or cannot be read."""
    try:
        with path.open("rb") as file:
            head = file.read(STL_HEADER_BYTES)
        size = path.stat().st_size
    except OSError:
        return ""
    facets = int.from_bytes(head[80:84], "little")
    if facets and size == STL_HEADER_BYTES + STL_FACET_BYTES * facets:
        return ".stl"
    return next((ending for beginning, ending in SIGNATURES.items() if head.startswith(beginning)), "")
