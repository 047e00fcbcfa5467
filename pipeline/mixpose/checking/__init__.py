"""What can be said of a session before its poses are estimated.

`recordings` reads every frame and counts features in some, `keys` says which key to change where
the count is off and the body is found with that change, doubts calibrations and widths, and finds
bodies that could be taken for each other and recordings that are given twice, `placement` looks at
where sensors stand and the body starts, `lookalikes` finds poses that the sensors could not tell
apart. `geometry` takes a few frames all over the recording, and `trials` tries what else the
session could have said: `changes` of it as a whole, by two of them, and `values` that are adjusted
to what sensors met; `evidence` says what they met and how well frames are explained, `rules` when a
change is told.
"""

from mixpose.checking.changes import times_as_large as times_as_large
from mixpose.checking.geometry import CAUSES as CAUSES
from mixpose.checking.keys import judge as judge, key_warnings as key_warnings
from mixpose.checking.keys import shared_source_warnings as shared_source_warnings
from mixpose.checking.lookalikes import LookAlike as LookAlike, look_alikes as look_alikes
from mixpose.checking.lookalikes import noise_of as noise_of
from mixpose.checking.placement import with_image_sizes as with_image_sizes
from mixpose.checking.trials import explanation as explanation, late_sensor as late_sensor
