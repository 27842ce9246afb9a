"""The shortest way to an image: simulate a strip, estimate its Doppler centroid, focus it."""

import torchsar
from torchsar import compensate, focus, plot, radar, scene
from torchsar.echo import simulate

sensor = radar.StripmapRadar(
    carrier_hz=3.2e9,
    pulse=radar.LinearFM(bandwidth_hz=40e6, duration_s=0.5e-6),
    sampling_hz=50e6,
    prf_hz=400.0,
    velocity_m_s=120.0,
    near_range_m=4000.0,
    pointing_doppler_hz=0.0,
)
targets = scene.Points(azimuth_m=[0.0, 12.0, -15.0], range_m=[0.0, 40.0, -55.0])
world = scene.StripmapWorld(targets, scene.Dwell(dwell_s=1.0), doppler_hz=25.0, snr_db=10.0)
recording, truth = simulate(sensor, world, n_pulse=1024, n_range=256, draws=torchsar.Draws(seed=1))

chain = torchsar.Chain(
    doppler=compensate.PhaseIncrement(sensor),
    focus=torchsar.use(focus.OmegaK(sensor), doppler_hz="doppler.doppler_baseband_hz"),
)
trace = chain.trace(recording)
print(
    f"Doppler {float(trace.values['doppler.doppler_baseband_hz']):.1f} Hz, true "
    f"{float(truth.values['doppler_hz']):.1f} Hz"
)
plot.save(plot.image(trace.signal, title="three points", percentile=100), "first_image.png")
