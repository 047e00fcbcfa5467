"""Report a run on one page: `series` gathers, `figures` draw, `overlays` read the recording again.

`page` puts them into the template `page.html.j2`; the page needs no other file and no network.
"""
