"""Places as files for other programs: glTF, OpenUSD, 3D Tiles, Blender. Nothing here renders."""
