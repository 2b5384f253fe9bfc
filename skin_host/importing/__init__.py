"""Files of the iCub's world turned into a configuration of ours: `skin import`."""
