"""Check a session and its recording before poses are estimated.

`recordings` reads every frame; `keys`, `placement` and `lookalikes` warn by the session itself and
by counts of features.  `geometry` estimates a few frames, and `trials` tries corrections of the
session, `changes` of it as a whole and `values` fitted to matches, by `evidence` and `rules`.
"""

from mixpose.checking.changes import times_as_large as times_as_large
from mixpose.checking.geometry import CAUSES as CAUSES
from mixpose.checking.keys import judge as judge, key_warnings as key_warnings
from mixpose.checking.keys import shared_source_warnings as shared_source_warnings
from mixpose.checking.lookalikes import LookAlike as LookAlike, look_alikes as look_alikes
from mixpose.checking.lookalikes import noise_of as noise_of
from mixpose.checking.placement import with_image_sizes as with_image_sizes
from mixpose.checking.trials import explanation as explanation, late_sensor as late_sensor
