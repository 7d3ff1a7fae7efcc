"""Files that VTK writes."""

from recordings import POINTS


def triangle_with(*texts):
    """Polygonal data with a field array SPACE, if there are texts for it."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints, vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    corners, faces, poly, space = vtkPoints(), vtkCellArray(), vtkPolyData(), vtkStringArray()
    corners.SetData(numpy_to_vtk(POINTS, deep=True))
    faces.InsertNextCell(3, [0, 1, 2])
    poly.SetPoints(corners)
    poly.SetPolys(faces)
    space.SetName("SPACE")
    for text in texts:
        space.InsertNextValue(text)
    if texts:
        poly.GetFieldData().AddArray(space)
    return poly


def legacy_vtk(path, poly, is_binary, version=51):
    """Write polygonal data as VTK does."""
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter

    writer = vtkPolyDataWriter()
    writer.SetFileName(str(path))
    writer.SetFileType(2 if is_binary else 1)
    writer.SetFileVersion(version)
    writer.SetInputData(poly)
    assert writer.Write()
    return path
