"""Show a run on a page in the browser: pictures, the scene in space, status over time.

    run --watch--> Viewer (newest moment wins) --pipe--> process of the page --> browsers

The page runs in a separate process, so that drawing does not slow the run; it gets a moment when it
asks for one, and skips those in between.
"""

from mixpose.viewing.viewer import Viewer as Viewer
