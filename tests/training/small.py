"""Changes that make the network of a preset tiny."""

SMALL = (
    "model.x_range=[-12.8,12.8]",
    "model.y_range=[-12.8,12.8]",
    "model.pillar=0.8",
    "model.pillar_channels=16",
    "model.block_layers=[1,1,1]",
    "model.block_channels=[8,16,16]",
    "model.up_channels=8",
    "model.shrink_channels=16",
    "threads=1",
)
