"""A page in the browser while a run goes on: pictures, the scene in space, status over time.

    run --watch--> Viewer (newest moment wins) --pipe--> process of the page --> browsers

The page has a process of its own, so that drawing takes no time from the run; it is told a moment
when it asks for one, and the moments in between are left out.
"""

from mixpose.viewing.viewer import Viewer as Viewer
