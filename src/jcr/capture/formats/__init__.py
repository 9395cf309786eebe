"""Formats of captures, a module each: `recognises(path)` tests a file or folder, `read(path, options)` reads it.

`read` returns a Capture or PosePairs. Of a recording, whose images are inside a file, it takes (path, options, folder to
extract the images to, progress).
"""
