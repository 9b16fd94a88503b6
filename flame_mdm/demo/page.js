const FAR = 20  // meters that a waypoint may be from the start
const parse = (text) => text.split('|').map((part) => part.match(/^([^]*?)(?:@([^@]*))?$/).slice(1).map((s) => (s || '').trim()))
const duration = (text, seconds) => parse(text).reduce((sum, part) => sum + (parseFloat(part[1]) || seconds), 0)

// Rows of a sequence and a path on the floor. Both show and change fields of the form; only the form stores the values.
const editor = (() => {
  const field = (id) => document.querySelector(`#${id} textarea, #${id} input`)
  const write = (id, value) =>
    Object.assign(field(id), { value }).dispatchEvent(new Event('input', { bubbles: true }))
  const join = (rows) => rows.map(([words, seconds]) => words + (seconds && ` @${seconds}`)).join(' | ')
  const read = () => [...document.querySelectorAll('#parts .part')].map((row) =>
    [...row.querySelectorAll('input')].map((input) => input.value.replace(/[|@]/g, ' ').trim()))
  const points = (path) => path.trim().split(/\s+/).map((point) => point.split(',').map(Number))
    .filter((point) => point.length === 2 && point.every(Number.isFinite))
  let shown = ['', 3, '']

  function drawParts(text) {
    const rows = parse(text), several = rows.length > 1
    if (several && join(rows) === join(read())) return
    document.querySelector('#parts').classList.toggle('several', several)
    document.querySelector('#parts .list').replaceChildren(...(several ? rows : []).map((values, index) => {
      const row = Object.assign(document.createElement('div'), { className: 'part', innerHTML:
        `<input aria-label="Action ${index + 1}" placeholder="What the person does next">
        <input aria-label="Seconds of action ${index + 1}" inputmode="decimal" placeholder="${shown[1]}">
        <button type="button" class="remove" aria-label="Remove action ${index + 1}">×</button>` })
      row.querySelectorAll('input').forEach((input, column) => { input.value = values[column] })
      return row
    }))
  }

  function drawPath(way, seconds) {
    const svg = document.querySelector('#floor svg'), line = [[0, 0], ...way]
    const far = Math.max(3, 1.2 * seconds, ...way.map(([x, z]) => Math.max(Math.abs(x), z, -2 * z) + 0.5))
    const size = Math.min(FAR, Math.ceil(far)), unit = size / 100, step = size > 8 ? 5 : 1
    const grid = Array.from({ length: 2 * FAR / step + 1 }, (_, k) => k * step - FAR)
    document.querySelector('#floor').open ||= way.length > 0
    svg.setAttribute('viewBox', `${-size} ${-size} ${2 * size} ${1.5 * size}`)
    svg.innerHTML = `<path class="grid" d="${grid.map((at) => `M${at},${-FAR}V${FAR}M${-FAR},${at}H${FAR}`).join('')}" />
      <text class="scale" x="${4 * unit - size}" y="${size / 2 - 4 * unit}" font-size="${7 * unit}">1 square = ${step} m</text>
      <polyline points="${line.map(([x, z]) => `${-x},${-z}`).join(' ')}" />
      <path class="start" d="M0,${-7 * unit}L${5 * unit},${5 * unit}H${-5 * unit}Z" />` +
      way.map(([x, z], index) => `<g data-point="${index}"><circle cx="${-x}" cy="${-z}" r="${6 * unit}" />
        <text x="${-x}" y="${2.6 * unit - z}" font-size="${7.5 * unit}">${index + 1}</text></g>`).join('')
    const meters = way.reduce((sum, [x, z], index) => sum + Math.hypot(x - line[index][0], z - line[index][1]), 0)
    document.querySelector('#floor output').textContent = way.length
      ? `${meters.toFixed(1)} m in ${+seconds.toFixed(2)} s: ${(meters / seconds).toFixed(1)} m/s`
      : 'Seen from above. Click to add waypoints, in order; click one to remove it.'
  }

  document.addEventListener('input', (event) => {
    if (event.target.closest('#parts')) write('text', join(read()))
  })
  function generate(text) {
    write('text', text)
    setTimeout(() => document.querySelector('#go').click(), 50)  // after the form has received the new value
  }

  document.addEventListener('change', (event) => {
    if (event.target.closest('#notes select')) generate(event.target.value)
  })
  document.addEventListener('click', (event) => {
    const example = event.target.closest('#examples button, #notes button')
    if (example) generate(example.textContent)
    const row = event.target.closest('#parts .remove')?.parentElement, floor = event.target.closest('#floor svg')
    if (row) {
      write('text', join(read().filter((_, index) => row.parentElement.children[index] !== row)))
    } else if (event.target.closest('#parts .add')) {
      const text = join([...parse(field('text').value), ['', '']])
      drawParts(text)
      document.querySelector('#parts .part:last-child input').focus()
      write('text', text)
    } else if (event.target.closest('#floor .clear')) {
      write('path', '')
    } else if (floor) {
      const hit = event.target.closest('[data-point]'), way = points(field('path').value)
      const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(floor.getScreenCTM().inverse())
      if (hit) way.splice(+hit.dataset.point, 1)
      else way.push([-at.x, -at.y].map((meters) => +meters.toFixed(1) || 0))
      write('path', way.map(String).join(' '))
    }
  })
  return (...values) => {  // without values: the editors have appeared
    if (values.length) shown = [values[0] || '', +values[1] || 3, values[2] || '']
    if (!document.querySelector('#floor')) return
    drawParts(shown[0])
    drawPath(points(shown[2]), duration(shown[0], shown[1]))
  }
})()

// Query strings of requests. The server checks them; `flame_mdm/demo/request.py` describes the keys.
const links = (() => {
  const STRENGTH = 0.5, SAMPLES = 3  // of variations
  const NUMBERS = ['seed', 'samples']

  function compose(keys, values) {
    const pairs = keys.map((key, k) => [key, values[k]]).filter(([, value]) => value != null && value !== '')
    return String(new URLSearchParams(pairs))
  }

  function read(keys, values) {  // the request in the page's address, and the values for its form
    const link = new URLSearchParams(location.search)
    if (![...link.keys()].some((key) => !key.startsWith('__'))) return [compose(keys, values), ...values]
    const shown = keys.map((key, k) => {
      const value = link.get(key)
      if (value === null) return key === 'text' ? '' : values[k]
      if (NUMBERS.includes(key)) return Number.isFinite(+value) ? +value : values[k]
      return ['cleanup', 'split'].includes(key) ? !/^(false|f|no|n|off|0)$/i.test(value) : value
    })
    return [location.search.slice(1), ...shown]
  }

  function withEdit(query, edit) {
    const set = Object.entries(edit).filter(([, value]) => value != null && value !== '' && String(value) !== '')
    return `${query}&${new URLSearchParams({ edit: JSON.stringify(Object.fromEntries(set)) })}`
  }

  function change(query, motion, text, begin, end, joints, seed) {
    const link = new URLSearchParams(query)
    const total = duration(link.get('text') || '', +link.get('seconds') || 3)
    const region = begin || end ? [begin || 0, end || total] : null
    return withEdit(query, { motion, text, region_seconds: region, joints, seed })
  }

  function vary(query, motion, seed) {
    return withEdit(query, { motion, strength: STRENGTH, samples: SAMPLES, seed })
  }
  return { compose, read, change, vary }
})()
