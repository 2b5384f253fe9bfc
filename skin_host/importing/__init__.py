"""`skin import`: turns files of the iCub software into a skin-host configuration."""
