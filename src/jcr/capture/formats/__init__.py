"""Formats of captures, one module each: `recognises(path)` tests a file or folder, `read(path, options)` reads it.

`read` returns a Capture or PosePairs. For recordings, whose images are stored inside a file, the arguments of `read`
are (path, options, folder to extract the images to, progress).
"""
